import numpy as np
import pytest
from diagnose_cases import lagged, profile, recording

from training.diagnose.groups import GROUPS
from training.diagnose.library import low_pass, play
from training.diagnose.prepare import prepare, survey
from training.effects.catalogue import catalogue


@pytest.fixture(scope="module")
def work():
    rec = recording(1)
    c = rec.columns
    return prepare("a", c, c["rate_dps"], c["ref_rate_dps"], c["ref_rate_dps"], np.ones(len(rec), bool))


def test_low_pass_agrees_with_small_euler_steps():
    _, _, temp = profile()
    np.testing.assert_allclose(low_pass(temp, 0.5, 120.0), lagged(temp, 120.0), atol=2e-3)


def test_play_stays_within_its_width_and_moves_only_when_pushed():
    values = np.cumsum(np.random.default_rng(2).standard_normal(3000))
    p = play(values, 2.0)
    assert np.all(np.abs(p - values) <= 2.0 + 1e-12)
    moved = np.flatnonzero(np.diff(p))
    np.testing.assert_allclose(np.abs(p - values)[moved + 1], 2.0)


def test_every_group_gives_finite_columns_with_a_name_each(work):
    found = survey([work])
    tried = 0
    for group in (g for g in GROUPS if g.needs <= found.has):
        assert group.effect in catalogue()
        for parameters in group.grid(found):
            columns = group.columns(work, parameters)
            assert len(columns) == len(group.linear(parameters))
            assert all(np.all(np.isfinite(c)) and c.shape == work.t.shape for c in columns)
            tried += 1
    assert tried > 200
