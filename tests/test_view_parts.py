"""Colours, the scene's box, thinning, the history and the cells: identities, no rerun needed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcomp.view.cells import Cells
from rtcomp.view.colours import diverging
from rtcomp.view.scene import HEIGHT, SIDE, make_box, ticks
from rtcomp.view.thinning import History, thin


def lightness(rgba):
    """CIE L* of sRGB colours, by the standard's own formulas and not by the map's."""
    c = rgba[..., :3] / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return np.where(y > 216 / 24389, 116.0 * np.cbrt(y) - 16.0, y * 24389 / 27)


def test_colours_are_lightest_at_zero_and_darken_evenly_to_both_sides():
    scale = np.linspace(-1.0, 1.0, 101)
    light = lightness(diverging(scale, 1.0))
    assert light.argmax() == 50
    for arm in (light[50:], light[50::-1]):
        steps = -np.diff(arm[::5])
        assert steps.min() > 0.5 * steps.mean()
        assert steps.max() < 1.5 * steps.mean()


def test_colours_tell_the_sign_and_saturate():
    negative, positive = diverging(np.array([-1.0, 1.0]), 1.0).astype(int)
    assert negative[2] > negative[0] + 60
    assert positive[0] > positive[2] + 60
    assert (diverging(np.array([5.0, 9.0]), 1.0) == positive).all()
    assert (diverging(np.array([0.0]), 0.0) == diverging(np.array([0.0]), 1.0)).all()


def test_the_box_is_centred_on_zero_error_and_holds_what_it_was_made_for():
    box = make_box((-40.0, 85.0), (-300.0, 300.0), 11.57)
    assert box.place(22.5, 0.0, 0.0) == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    corner = box.place(-40.0, 300.0, 11.57)
    assert np.abs(corner)[:2].max() < SIDE / 2
    assert abs(corner[2]) <= HEIGHT / 2
    assert np.abs(box.place(1e6, -1e6, 1e6)) == pytest.approx([SIDE / 2, SIDE / 2, HEIGHT / 2])


@given(st.floats(-1e3, 1e3), st.floats(1e-3, 1e4))
def test_ticks_are_round_and_inside(low, span):
    marks = ticks(low, low + span)
    assert 1 <= len(marks) <= 8
    assert marks.min() >= low - 1e-6 * span
    assert marks.max() <= low + span * (1 + 1e-6)


@given(st.integers(1, 5000), st.integers(2, 400))
def test_thinning_keeps_both_extremes_and_the_order(n, rows):
    values = np.random.default_rng(n).normal(size=n)
    kept = thin(values, rows)
    assert len(kept) <= max(rows, 2)
    assert (np.diff(kept) > 0).all()
    assert values[kept].max() == values.max()
    assert values[kept].min() == values.min()


def test_history_keeps_the_mean_of_everything_in_fixed_room():
    rng = np.random.default_rng(3)
    history, values = History(2, room=64), rng.normal(size=(50_000, 2))
    values[::7, 1] = np.nan
    t_ns = np.arange(50_000) * 100_000_000 + 1_700_000_000_000_000_000
    for rows in np.array_split(np.arange(50_000), 900):
        history.add(t_ns[rows], values[rows])
    t, means = history.rows()
    assert 32 <= len(t) <= 64
    assert (np.diff(t) == history.interval_ns).all()
    counts = np.histogram(t_ns, np.append(t, t[-1] + history.interval_ns))[0]
    assert (means[:, 0] @ counts) / counts.sum() == pytest.approx(values[:, 0].mean(), abs=1e-9)
    assert np.isfinite(means).all()


def test_cells_average_errors_where_they_were_seen():
    box = make_box((0.0, 30.0), (-50.0, 50.0), 2.0)
    cells = Cells(box)
    temp, rate = np.full(100, 10.0), np.full(100, 20.0)
    errors = np.stack([np.linspace(1.0, 2.0, 100), np.linspace(-0.1, 0.1, 100)], axis=-1)
    errors[50] = np.nan
    cells.add(temp, rate, errors)
    before, after = cells.means()
    assert len(cells) == 1
    i, j = np.argwhere(np.isfinite(before.error_dps))[0]
    assert abs(before.temp_degC[i] - 10.0) <= np.diff(before.temp_degC)[0] / 2
    assert abs(before.rate_dps[j] - 20.0) <= np.diff(before.rate_dps)[0] / 2
    assert before.error_dps[i, j] == pytest.approx(np.nanmean(errors[:, 0]))
    assert after.error_dps[i, j] == pytest.approx(np.nanmean(errors[:, 1]))
