"""The compensator over single values and over arrays: the same compiled step as on the bus."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rtcomp.compiled import Compiled, compile_models
from rtcomp.errors import RequestError
from rtcomp.frames import Flag
from rtcomp.jit import hot_kernel
from rtcomp.model import Model
from rtcomp.step import predict_error, sigma
from rtcomp.thermal import T_POWER_ON, forget, new_state, thermal_update

FIRST = np.uint64(0)  # a compensator has one channel


class Prediction(NamedTuple):
    """Per row: predicted error [°/s], its standard deviation [°/s] (NaN: not stated), flags (`Flag` bits)."""

    error_dps: np.ndarray
    sigma_dps: np.ndarray
    flags: np.ndarray


class Compensator:
    """A stack of models with its state.

    Call `temperature` with every temperature (ns, °C) and `correct` with every rate (ns, °/s in, °/s out), in the
    order of their times.
    """

    def __init__(self, models: Sequence[Model], power_on_ns: int | None = None) -> None:
        self.compiled: Compiled = compile_models([models])
        self.state = new_state(self.compiled)
        if power_on_ns is not None:
            self.state.times[0, T_POWER_ON] = power_on_ns

    def temperature(self, t_ns: int, temp_degC: float, coil_temp_degC: float = float("nan")) -> None:
        """Take in a temperature received at `t_ns`."""
        thermal_update(self.compiled, self.state, FIRST, t_ns, temp_degC, coil_temp_degC)

    def correct(self, t_ns: int, rate_dps: float) -> tuple[float, Flag]:
        """The corrected rate [°/s] and the model's flags."""
        error, flags = predict_error(self.compiled, self.state, FIRST, t_ns, rate_dps)
        return rate_dps - error, Flag(flags)


def predict(
    models: Model | Sequence[Model],
    rate_dps: np.ndarray,
    temp_degC: np.ndarray,
    t_s: np.ndarray | None = None,
    coil_temp_degC: np.ndarray | None = None,
    power_on_known: bool = True,
) -> Prediction:
    """Predict the error of every row of a recording.

    Args:
        models: one model or a stack whose predictions add up.
        rate_dps: measured rate, shape (n,).
        temp_degC: reported temperature, shape (n,); a NaN keeps the last one.
        t_s: time, shape (n,), 0 at power-on when `power_on_known`; None makes the rows independent soaked points.
        coil_temp_degC: shape (n,), where the recording has it.

    Raises:
        RequestError: when the shapes differ.
    """
    stack = [models] if isinstance(models, Model) else list(models)
    rate = np.ascontiguousarray(rate_dps, np.float64)
    temp = np.ascontiguousarray(temp_degC, np.float64)
    coil = (
        np.full(rate.shape, np.nan)
        if coil_temp_degC is None
        else np.ascontiguousarray(coil_temp_degC, np.float64)
    )
    t_ns = np.zeros(rate.shape, np.int64) if t_s is None else np.rint(np.asarray(t_s) * 1e9).astype(np.int64)
    if not rate.shape == temp.shape == coil.shape == t_ns.shape or rate.ndim != 1:
        raise RequestError(
            f"rate, temperature and time differ in shape: {rate.shape}, {temp.shape}, {t_ns.shape}"
        )
    compensator = Compensator(stack, 0 if power_on_known and t_s is not None else None)
    error, std, flags = np.empty(rate.shape), np.empty(rate.shape), np.zeros(rate.shape, np.int64)
    predict_recording(
        compensator.compiled,
        compensator.state,
        t_s is None,
        t_ns,
        rate,
        temp,
        coil,
        error,
        std,
        flags,
    )
    return Prediction(error, std, flags)


@hot_kernel
def predict_recording(c, s, independent, t_ns, rate, temp, coil, error, std, flags):
    """Fill `error`, `std` and `flags` (n,) row by row."""
    for i in range(rate.shape[0]):
        if independent:
            forget(s, FIRST)
        if not np.isnan(temp[i]):
            thermal_update(c, s, FIRST, t_ns[i], temp[i], coil[i])
        error[i], flags[i] = predict_error(c, s, FIRST, t_ns[i], rate[i])
        std[i] = sigma(c, s, FIRST, rate[i])
