"""Static terms of the rate, expressed in the rate the compensator has.

The diagnosis fits an error e(ω, T) of the true rate; the compensator knows the measured one, m = ω + e. Where e is a
few percent of ω its coefficients are fitted once more, so that the same terms of m give the error that was found.
"""

from collections.abc import Sequence

import numpy as np

from rtcomp.compensator import predict
from rtcomp.model import Model, Term, new_model
from rtcomp.terms import TERMS
from training.diagnose.intake import Intake
from training.diagnose.library import ROOM_DEGC
from training.diagnose.work import FloatArray
from training.effects.catalogue import catalogue

STATIC_OF_RATE = {
    "scale_error": ("ppm",),
    "scale_temperature": ("s1_ppm_per_K", "s2_ppm_per_K2", "s3_ppm_per_K3"),
    "scale_nonlinearity": ("c3_per_dps2", "c5_per_dps4", "c3h_per_dps2_per_K"),
}
ALIKE = 0.01  # share of the predicted error below which measured and true rate give the same
ENOUGH_ROWS = 100_000


def in_measured_rate(terms: Sequence[Term], intakes: Sequence[Intake], base: Model | None) -> list[Term]:
    """The terms with the coefficients of `STATIC_OF_RATE` fitted to the measured rate, where that matters."""
    if not any(t.effect in STATIC_OF_RATE for t in terms):
        return list(terms)
    wanted = _over(terms, intakes, base, true_rate=True)
    if np.std(wanted - _over(terms, intakes, base)) <= ALIKE * np.std(wanted):
        return list(terms)
    others = [t for t in terms if t.effect not in STATIC_OF_RATE]
    names = [(t.effect, name) for t in terms for name in STATIC_OF_RATE.get(t.effect, ())]
    needed = {effect: dict.fromkeys(TERMS[effect].required, 0.0) for effect, _ in names}
    units = [Term(effect, {**needed[effect], name: 1.0}) for effect, name in dict.fromkeys(names)]
    columns = np.stack([_over([unit], intakes, base) for unit in units], axis=1)
    size = np.max(np.abs(columns), axis=0) + 1e-300
    step = 1 + len(columns) // ENOUGH_ROWS
    target = wanted - _over(others, intakes, base)
    values = np.linalg.lstsq((columns / size)[::step], target[::step], rcond=None)[0] / size
    fitted: dict[str, dict[str, float]] = {}
    for (effect, name), value in zip(dict.fromkeys(names), values, strict=True):
        fitted.setdefault(effect, {})[name] = float(value)
    return [*(Term(effect, dict(p)) for effect, p in fitted.items()), *others]


def left_by_model(base: Model, intakes: Sequence[Intake], power_on_known: bool) -> float:
    """What share of a found error is left for the live terms once the model has corrected the rate that carries it too.

    The simulated rate is what the model says of the true rate; live it sees the measured one, and with it takes e' of
    every error away that it does not know.
    """
    left, whole = [], []
    for intake in intakes:
        c, rows = intake.checked.columns, intake.checked.valid
        temp = c.get("temp_degC", np.full(len(rows), ROOM_DEGC))
        rate = np.nan_to_num(c["rate_dps"])
        known = predict(base, rate, temp, c.get("t_s"), c.get("coil_temp_degC"), power_on_known)
        left.append((rate - known.error_dps - c["ref_rate_dps"])[rows])
        whole.append(intake.residual[rows])
    x, y = np.concatenate(whole), np.concatenate(left)
    return float(x @ y / (x @ x)) if np.any(x) else 1.0


def sized(term: Term, share: float) -> Term:
    """A term with its error times `share`."""
    known = catalogue().get(term.effect)
    linear = {"values"} if known is None else {name for name, p in known.parameters.items() if p.linear}
    return Term(
        term.effect,
        {
            name: (np.asarray(value, dtype=float) * share).tolist() if name in linear else value
            for name, value in term.parameters.items()
        },
    )


def _over(
    terms: Sequence[Term], intakes: Sequence[Intake], base: Model | None, true_rate: bool = False
) -> FloatArray:
    """What the compensator predicts [°/s] with these terms on all sound rows, given the measured or the true rate."""
    model = new_model(terms=[{"effect": t.effect, "parameters": dict(t.parameters)} for t in terms])
    parts = []
    for intake in intakes:
        c = intake.checked.columns
        temp = c.get("temp_degC", np.full(len(intake.driving), 25.0))
        shown = intake.driving if true_rate else np.nan_to_num(c["rate_dps"])
        if base is not None and not true_rate:
            shown = shown - predict(base, shown, temp, c.get("t_s"), c.get("coil_temp_degC")).error_dps
        parts.append(predict(model, shown, temp, c.get("t_s")).error_dps[intake.checked.valid])
    return np.concatenate(parts)
