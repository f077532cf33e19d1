"""How fast GK + RLS identifies: on the paper's 448 points, beside pyFUME, and in rows up to 10⁷.

All times are CPU times of one thread, so that what else the machine does is not counted for or against anyone.

    python -m tools.bench_train [--rows 10000000] [--pyfume]

`--pyfume` makes a virtual environment of its own (in --venv) and installs pyFUME there: it is nobody's dependency.
"""

import json
import os
import resource
import subprocess
import sys
import time
import venv
from pathlib import Path

import click
import numpy as np

from training.gk import Settings
from training.rate_table import simulate, split_points
from training.shown import Shown
from training.ts import TsFit, TsOptions, fit

NAMES = ("temp_degC", "rate_dps")
TURNS = 5
PYFUME = """
import contextlib, io, json, sys, time, warnings
import numpy as np, pandas as pd
warnings.simplefilter("ignore")
from pyfume import pyFUME, Clustering, EstimateConsequentParameters
points = np.loadtxt(sys.argv[1], delimiter=",")
frame = pd.DataFrame(points, columns=["temp", "rate", "error"])
bare, whole = [], []
for _ in range(5):
    begin = time.process_time()
    clusterer = Clustering.Clusterer(x_train=points[:, :2], y_train=points[:, 2], nr_clus=4)
    centers, partition, _ = clusterer.cluster(method="gk")
    EstimateConsequentParameters.ConsequentEstimator(points[:, :2], points[:, 2], partition).suglms()
    bare.append(time.process_time() - begin)
    with contextlib.redirect_stdout(io.StringIO()):
        begin = time.process_time()
        pyFUME(dataframe=frame, nr_clus=4, cluster_method="gk", method="Takagi-Sugeno", percentage_training=1.0)
        whole.append(time.process_time() - begin)
print(json.dumps([sorted(bare)[2], sorted(whole)[2]]))
"""


def table_points(seed: int = 0) -> np.ndarray:
    """The 448 training points [°C, °/s, °/s] of one simulated rate table."""
    table = simulate(seed)
    train = split_points(table)
    return np.column_stack([table.temp_degC, table.rate_dps, table.error_dps])[train]


def per_start(points: np.ndarray, starts: int) -> np.ndarray:
    """CPU seconds of GK + RLS for each of `starts` single starts, after compilation."""
    times = np.empty(starts)
    run(points, 0)
    for seed in range(starts):
        begin = time.process_time()
        run(points, seed)
        times[seed] = time.process_time() - begin
    return times


def run(points: np.ndarray, seed: int) -> TsFit:
    """One start of the paper's algorithm with 4 rules."""
    settings = Settings(starts=1, seed=seed)
    return fit(points[:, :2], points[:, 2], NAMES, TsOptions("gk-rls", clustering=settings))


def scaling(largest: int, iterations: int = 20) -> list[dict[str, float]]:
    """CPU seconds and peak memory beyond the input for growing recordings, at a fixed number of iterations."""
    told = []
    for rows in [n for n in (10_000, 100_000, 1_000_000, 10_000_000) if n <= largest]:
        points = tiled(rows)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with Shown(f"{rows} rows") as shown:
            begin = time.process_time()
            settings = Settings(starts=1, max_iterations=iterations, tolerance=0.0)
            fit(
                points[:, :2],
                points[:, 2],
                NAMES,
                TsOptions("gk-rls", clustering=settings),
                lambda iteration, change, shown=shown: shown.tick(
                    f"iteration {iteration}, ‖ΔΛ‖ {change:.1e}"
                ),
            )
            seconds = time.process_time() - begin
        grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
        told.append(
            {
                "rows": rows,
                "seconds": seconds,
                "ns_per_row": 1e9 * seconds / rows,
                "memory": grown / points.nbytes,
            }
        )
    return told


def tiled(rows: int) -> np.ndarray:
    """The rate table repeated with fresh noise, simulated."""
    points = table_points()
    rng = np.random.default_rng(1)
    many = points[rng.integers(0, len(points), rows)]
    many += rng.standard_normal(many.shape) * [0.1, 0.01, 0.01]
    return many


def pyfume_seconds(points: np.ndarray, folder: Path) -> tuple[float, float]:
    """CPU seconds of pyFUME on the same points, in its own environment: bare GK and consequents, and its own call.

    It runs in that environment's folder, since it writes files wherever it runs.
    """
    folder = folder.resolve()
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "pyfume==0.3.4"], check=True, timeout=600)
    file = folder / "points.csv"
    np.savetxt(file, points, delimiter=",")
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [python, "-c", PYFUME, file],
        check=True,
        capture_output=True,
        text=True,
        timeout=600,
        env=environment,
        cwd=folder,
    )
    bare, whole = json.loads(done.stdout.splitlines()[-1])
    return bare, whole


def compare(points: np.ndarray, starts: int, folder: Path) -> None:
    """Print pyFUME's times over ours, each the median of turns that alternate."""
    turns = []
    for _ in range(TURNS):
        ours = float(np.median(per_start(points, starts)))
        turns.append([ours, *pyfume_seconds(points, folder)])
    ours, bare, whole = np.median(turns, axis=0)
    times_bare, times_whole = np.median([[t[1] / t[0], t[2] / t[0]] for t in turns], axis=0)
    click.echo(
        f"pyFUME 0.3.4, one start on the same points, identification by its own call: {1e3 * whole:.0f} ms, "
        f"{times_whole:.0f}× ours ({1e3 * ours:.1f} ms)"
    )
    click.echo(
        f"pyFUME 0.3.4, of that its GK and consequents alone: {1e3 * bare:.0f} ms, {times_bare:.0f}× ours "
        "(it stops at ‖ΔΛ‖ 0.01 over all entries and has no RLS; ours at 1e-4 in the largest)"
    )


@click.command()
@click.option("--rows", default=1_000_000, show_default=True, help="Largest recording to time.")
@click.option("--starts", default=50, show_default=True, help="Random starts to time on the 448 points.")
@click.option("--pyfume", is_flag=True, help="Time pyFUME, too (installs it into --venv).")
@click.option("--venv", "folder", default=".bench/pyfume", show_default=True, type=click.Path(path_type=Path))
def main(rows: int, starts: int, pyfume: bool, folder: Path) -> None:
    """Print the figures, one per line."""
    points = table_points()
    times = 1e3 * per_start(points, starts)
    quantiles = np.quantile(times, [0.5, 0.9, 1.0])
    click.echo(
        "GK + RLS, 448 points, 4 rules, per start: {:.1f} ms median, {:.1f} ms p90, {:.1f} ms max".format(
            *quantiles
        )
    )
    if pyfume:
        compare(points, starts, folder)
    for told in scaling(rows):
        click.echo(
            f"{told['rows']:>9} rows, 20 iterations: {told['seconds']:.2f} s, {told['ns_per_row']:.0f} ns a row, "
            f"memory beyond the input {told['memory']:.2f}× of it"
        )


if __name__ == "__main__":
    sys.exit(main())
