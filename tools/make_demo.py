"""Make what `rtcomp demo` replays: `python -m tools.make_demo`. All of it is simulated.

The trace is the bundled scenario `demo_drive`. The model comes from another simulated recording, a soaked rate
table of the same gyro, identified with the trainer's default method; the demo's drive is not in it.
"""

import msgspec
import numpy as np

from rtcomp.demo import MODEL, TRACE
from rtcomp.model import save_model
from training.build import ts_model
from training.simulator.run import simulate, simulate_file
from training.simulator.scenario import load_scenario
from training.ts import TsOptions, fit

SEED = 11
RULES = 4


def main() -> None:
    """Write trace and model."""
    told = simulate_file("demo_drive", TRACE)
    table = simulate(load_scenario("rate_table"), seed=SEED)
    names = ["temp_degC", "rate_dps"]
    rows = np.column_stack([table[name] for name in names])
    found = fit(rows, table["rate_dps"] - table["ref_rate_dps"], names, TsOptions(rules=RULES))
    model = ts_model(found, names, rows)
    model = msgspec.structs.replace(
        model, provenance=model.provenance | {"data": f"simulated rate table, seed {SEED}"}
    )
    save_model(model, MODEL)
    print(f"{TRACE}: {told['frames']} frames; {MODEL}: residual {found.residual_std_dps:.4f} °/s")


if __name__ == "__main__":
    main()
