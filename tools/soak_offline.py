"""Memory over a long offline run: `python -m tools.soak_offline --frames 100000000 --json`.

FOG frames are generated and corrected in chunks, as a stream; resident memory is read after every chunk. A slope is
given with its 95 % interval (ordinary least squares over the second half, when everything has been allocated).
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from rtcomp import fog_format
from rtcomp.pipeline import Pipeline
from rtcomp.plan import compile_map
from rtcomp.signal_map import load_map
from tools.bench_core import START_NS, bench_model

CHUNK = 250_000
EVERY = 100  # rate frames per temperature frame
PERIOD_NS = 1_000_000


def resident_mib() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def chunk(number: int, random: np.random.Generator) -> np.ndarray:
    """Frames of one chunk; counters and time go on from the one before."""
    first = number * CHUNK
    t_ns = START_NS + (first + np.arange(CHUNK)) * PERIOD_NS
    slow = t_ns[::EVERY]
    temp = 20.0 + 20.0 * np.sin(slow * 1e-9 / 3000.0)
    temperature = fog_format.encode_temperature(slow, temp, temp, counter=first // EVERY)
    return fog_format.merge(
        temperature, fog_format.encode_rate(t_ns, random.uniform(-180, 180, CHUNK), counter=first)
    )


def soak(frames: int) -> dict[str, object]:
    """Run about `frames` frames; what it counted and how memory went."""
    pipeline = Pipeline(compile_map(load_map("fog")), {"yaw": [bench_model()]}, START_NS)
    random = np.random.default_rng(0)
    per_chunk = CHUNK + CHUNK // EVERY
    memory, samples = [], 0
    for number in range(-(-frames // per_chunk)):
        samples += sum(len(part.corrected) for part in pipeline.process(chunk(number, random)))
        memory.append(resident_mib())
    half = np.array(memory[len(memory) // 2 :])
    seen = np.arange(len(half)) * per_chunk / 1e6
    line: Any = stats.linregress(seen, half)
    margin = float(stats.t.ppf(0.975, len(half) - 2) * line.stderr) if len(half) > 2 else None
    return {
        "frames": pipeline.counts["frames"],
        "samples": samples,
        "rejected": pipeline.rejected,
        "rss_mib": {"first": memory[0], "last": memory[-1], "highest": max(memory)},
        "slope_mib_per_million_frames": {"value": float(line.slope), "plus_minus": margin},
    }


def main() -> None:
    """Print the outcome."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000_000)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    options = parser.parse_args()
    outcome = soak(options.frames)
    print(json.dumps(outcome) if options.json else "\n".join(f"{k}: {v}" for k, v in outcome.items()))


if __name__ == "__main__":
    main()
