from dataclasses import replace

import numpy as np
from diagnose_cases import recording

from training.diagnose.prepare import prepare, soaks
from training.diagnose.work import block_average, smooth


def made(points=False):
    rec = recording(1)
    c = dict(rec.columns)
    if points:
        c = {k: v[::40] for k, v in c.items() if k != "t_s"}
        c["temp_degC"] = np.round(c["temp_degC"] / 10) * 10
    return prepare(
        "a", c, c["rate_dps"], c["ref_rate_dps"], c["ref_rate_dps"], np.ones(len(c["rate_dps"]), bool)
    )


def test_the_transform_keeps_norms_for_series_and_points():
    rng = np.random.default_rng(1)
    for work in (made(), made(points=True)):
        columns = rng.standard_normal((len(work), 3))
        turned = work.transform(columns)
        np.testing.assert_allclose(turned.T @ turned, columns.T @ columns, rtol=1e-9, atol=1e-9)


def test_a_common_scale_error_of_a_soak_stays_in_the_first_rows():
    work = made(points=True)
    soak = np.asarray(work.clusters) == 0
    rows = work.transform((work.w * soak)[:, None])[:, 0]
    count = int(np.max(work.clusters)) + 1
    assert np.sum(rows[:count] ** 2) > (1 - 1e-12) * np.sum(rows**2)


def test_block_means_agree_with_a_loop():
    rng = np.random.default_rng(2)
    values, valid = rng.standard_normal(100), rng.random(100) > 0.3
    labels = np.arange(100) // 7
    means = block_average(labels, valid, 15)(values)
    for block in range(15):
        members = values[(labels == block) & valid]
        assert np.isclose(means[block], members.mean()) if len(members) else np.isnan(means[block])


def test_smoothing_keeps_a_straight_line():
    line = np.linspace(3.0, 9.0, 400)
    np.testing.assert_allclose(smooth(line, 1.0, 20.0), line, atol=1e-12)


def test_soaks_are_separated_by_temperature_jumps():
    labels = soaks(np.asarray([10.0, 10.1, 9.9, 30.0, 30.2, 29.9, 10.2]))
    assert labels[0] == labels[1] == labels[2] == labels[6]
    assert labels[3] == labels[4] == labels[5] != labels[0]


def test_spread_weights_the_columns():
    work = made()
    halved = replace(work, spread=np.full(len(work), 2.0))
    column = work.w[:, None]
    np.testing.assert_allclose(halved.transform(column) * 2.0, work.transform(column))
