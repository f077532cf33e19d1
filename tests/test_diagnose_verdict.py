"""What the sentence says of the proof: improved, worse, undecided, or nothing where nothing was predicted."""

import pytest

from training.diagnose.document import FitResult
from training.diagnose.verdict import proved


def fit(before, after, low, high, slow=None, heldout=True):
    keys = ("rms_before_dps", "rms_after_dps", "improvement", "ci95_low", "ci95_high")
    means = dict(zip(keys, (slow[0], slow[1], 1 - slow[1] / slow[0], *slow[2:]), strict=True)) if slow else {}
    return FitResult(before, after, 1 - after / before, (low, high), heldout, means)


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (
            fit(0.04, 0.004, 0.88, 0.92),
            "; with it the misfit of the held-out recordings goes from 0.04 to 0.004 °/s",
        ),
        (fit(0.04, 0.004, 0.8, 0.9, heldout=False), "; with it the misfit of held-out blocks goes"),
        (
            fit(0.1, 0.0999, -0.01, 0.02, (0.004, 0.002, 0.4, 0.6)),
            "; with it the misfit in means over blocks of",
        ),
        (fit(0.1, 0.13, -0.4, -0.2), "; but it does not hold: the misfit of"),
        (fit(0.1, 0.11, -0.2, 0.1, (0.01, 0.012, -0.4, -0.1)), "; but it does not hold: the misfit in means"),
        (
            fit(0.1, 0.09, -0.2, 0.1, (0.01, 0.009, -0.4, 0.1)),
            "; but that is not proved: the misfit in means",
        ),
    ],
)
def test_the_sentence_ends_with_what_the_proof_says(result, words):
    assert proved(result).startswith(words)


def test_what_a_control_does_as_well_is_not_proved():
    result = fit(0.166, 0.15, 0.08, 0.12, (0.1, 0.07, 0.25, 0.35))
    result.placebo_improvement = 0.31
    assert proved(result).startswith(
        "; but that is not proved: the misfit of the held-out recordings goes from"
    )
    result.placebo_improvement = 0.13
    assert proved(result).startswith("; with it")


def test_nothing_is_said_of_a_proof_where_nothing_was_predicted():
    assert proved(fit(0.1, 0.1, 0.0, 0.0, (0.01, 0.01, 0.0, 0.0))) == ""
