"""What a recording is compared with: a scenario of the gyro simulator, a model file, a column, or an ideal gyro."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from rtcomp.errors import RequestError
from training.diagnose.work import FloatArray

ROUNDS = 4  # a model's error is one of the measured rate: m = ω + e(m), where e' is a few percent


@dataclass(frozen=True)
class Simulation:
    """A simulation: `kind` is scenario, model, column or ideal; `noise` [deg/√h, deg/h, deg/h/√h] if it carries one."""

    kind: str
    scenario: Any = None
    model: Any = None
    noise: Mapping[str, float] | None = None

    def rate(
        self, name: str, columns: dict[str, FloatArray], static: bool, power_on_known: bool
    ) -> FloatArray:
        """Simulated measured rate [dps] for a recording's drivers, shape `(n,)`."""
        if self.kind == "scenario":
            return self._scenario_rate(name, columns, static)
        if self.kind == "model":
            from rtcomp.compensator import predict

            temp = columns.get("temp_degC")
            if temp is None:
                raise RequestError(
                    f"{name}: the model needs temp_degC, which the recording lacks; add the column"
                )
            true = rate = columns["ref_rate_dps"]
            for _ in range(ROUNDS):
                error = predict(
                    self.model, rate, temp, columns.get("t_s"), columns.get("coil_temp_degC"), power_on_known
                ).error_dps
                rate = true + error
            return rate
        if self.kind == "column":
            return columns["sim_rate_dps"]
        return columns["ref_rate_dps"]

    def _scenario_rate(self, name: str, columns: dict[str, FloatArray], static: bool) -> FloatArray:
        from training.simulator.on_recording import simulated_rate
        from training.table import Recording

        return simulated_rate(
            self.scenario, Recording(name, cast("dict[str, np.ndarray]", columns)), static=static
        )


def choose_simulation(source: Path | None, columns: list[dict[str, FloatArray]]) -> Simulation:
    """The simulation a request means: `source` (TOML scenario or model JSON), else the column, else an ideal gyro."""
    if source is None:
        have = ["sim_rate_dps" in c for c in columns]
        if any(have) and not all(have):
            raise RequestError(
                "only some recordings have sim_rate_dps; give it to all of them or use --simulation"
            )
        return Simulation("column" if all(have) else "ideal")
    if source.suffix == ".toml" or not source.suffix:
        from training.simulator.scenario import load_scenario

        scenario = load_scenario(source)
        noise = getattr(scenario.gyro, "noise", None)
        values = None if noise is None or isinstance(noise, str) else noise.values()
        return Simulation("scenario", scenario=scenario, noise=values)
    from rtcomp.model import load_model

    return Simulation("model", model=load_model(source))
