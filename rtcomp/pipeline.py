"""FRAME arrays in, CORRECTED arrays out: the frame loop with its map, models and counts.

Settings are the map and the models; the state is inside; the update is `process`: call it with every array of
frames, in the order of reception.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rtcomp.compiled import Compiled, compile_models
from rtcomp.decode import frame_words
from rtcomp.errors import RequestError
from rtcomp.frame_loop import run_loop
from rtcomp.frames import CORRECTED, Flag
from rtcomp.loop_state import CAUSES, LOST_FRAMES, TOTALS, LoopState, new_loop_state
from rtcomp.model import Model
from rtcomp.plan import CompiledMap
from rtcomp.samples import new_output
from rtcomp.step import new_rows
from rtcomp.terms import TERMS
from rtcomp.thermal import (
    LAST_COIL,
    LAST_TEMP,
    NEVER,
    T_POWER_ON,
    T_THERMAL,
    State,
    new_state,
    thermal_update,
)

BATCH = 4096
THERMAL_PARAMETERS = ("tau_s", "tau2_s", "smooth_s", "play_K")


class Samples(NamedTuple):
    """Corrected samples in the order of their frames, and the channel index of each."""

    corrected: np.ndarray  # CORRECTED (n,)
    channel: np.ndarray  # uint8 (n,)


Stacks = Mapping[str, Sequence[Model]]


class Pipeline:
    """One map, a stack of models per channel, and the state between frames."""

    def __init__(
        self, compiled_map: CompiledMap, models: Stacks | None = None, power_on_ns: int | None = None
    ) -> None:
        """`models` maps a channel's name to its stack (none: rates pass through, flagged).

        `power_on_ns` is when the sensor got power, on the frames' clock; None leaves terms in that time out.

        Raises RequestError for a model of a channel the map does not have.
        """
        self.map = compiled_map
        self.names = compiled_map.channel_names
        self.loop: LoopState = new_loop_state(compiled_map.plan)
        self.stacks: list[Sequence[Model]] = self._stacks(models or {})
        self.compiled: Compiled = compile_models(self.stacks)
        self.state: State = new_state(self.compiled)
        self._out = new_output(BATCH + len(self.names))
        self._rows = new_rows()
        if power_on_ns is not None:
            self.power_on(power_on_ns)

    def _stacks(self, models: Stacks) -> list[Sequence[Model]]:
        unknown = sorted(set(models) - set(self.names))
        if unknown:
            raise RequestError(f"model for channel {unknown[0]!r}; the map has {', '.join(self.names)}")
        return [list(models.get(name, ())) for name in self.names]

    def power_on(self, t_ns: int) -> None:
        """State when the sensor got power."""
        self.state.times[:, T_POWER_ON] = t_ns

    def process(self, frames: np.ndarray) -> Iterator[Samples]:
        """Take in frames; yields samples in pieces of bounded size, each valid until the next is asked for."""
        frames = np.ascontiguousarray(frames)
        words = frame_words(frames)
        out, done = self._out, 0
        while done < len(frames):
            done, count = run_loop(
                self.map.plan, self.compiled, self.state, self.loop, self._rows, frames, words, done, out
            )
            if count:
                yield Samples(out.corrected[:count], out.channel[:count])

    def process_all(self, frames: np.ndarray) -> Samples:
        """The samples of all frames at once."""
        parts = [Samples(part.corrected.copy(), part.channel.copy()) for part in self.process(frames)]
        if not parts:
            return Samples(np.zeros(0, CORRECTED), np.zeros(0, np.uint8))
        return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def swap(self, models: Stacks) -> None:
        """Take other models from the next frame on; thermal states that both have in common are kept.

        What is new starts as if soaked at the present temperature, flagged unsettled until that no longer matters.
        """
        stacks = self._stacks(models)
        compiled = compile_models(stacks)
        state = new_state(compiled)
        state.times[:, T_POWER_ON] = self.state.times[:, T_POWER_ON]
        for ch in range(len(self.names)):
            if self.state.times[ch, T_THERMAL] != NEVER:
                temp, coil = self.state.values[ch, LAST_TEMP], self.state.values[ch, LAST_COIL]
                thermal_update(compiled, state, np.uint64(ch), self.state.times[ch, T_THERMAL], temp, coil)
                if self._adopt(ch, stacks[ch], compiled, state):
                    state.times[ch] = self.state.times[ch]
                    state.values[ch] = self.state.values[ch]
        self.loop.marks[:] |= int(Flag.MODEL_SWAPPED)
        self.stacks, self.compiled, self.state = stacks, compiled, state

    def _adopt(self, ch: int, stack: Sequence[Model], compiled: Compiled, state: State) -> bool:
        """Copy the states of terms that are thermally the same; True when nothing of the new stack is unsettled."""
        old = {
            _thermal_key(t): k
            for k, t in enumerate(_terms(self.stacks[ch]), int(self.compiled.term_start[ch]))
        }
        complete = not any(model.inputs and model.filters for model in stack)
        for k, term in enumerate(_terms(stack), int(compiled.term_start[ch])):
            key = _thermal_key(term)
            if key in old:
                state.terms[k] = self.state.terms[old[key]]
            elif any(name in TERMS[term.effect].names for name in THERMAL_PARAMETERS):
                complete = False
        return complete

    @property
    def counts(self) -> dict[str, int]:
        """Frames, samples, frames lost before us, clock steps, frames nobody wanted."""
        return {name: int(value) for name, value in zip(TOTALS, self.loop.totals, strict=True)}

    @property
    def lost_frames(self) -> int:
        """Frames the receiver reports as lost before they reached us."""
        return int(self.loop.totals[LOST_FRAMES])

    @property
    def rms_dps(self) -> tuple[float, float] | None:
        """RMS error [°/s] against the reference, raw and corrected, over all channels; None without a reference."""
        n, raw, corrected = self.loop.scores.sum(axis=0)
        return (float(np.sqrt(raw / n)), float(np.sqrt(corrected / n))) if n else None

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected frames by cause; only causes that occurred."""
        return {cause: int(n) for cause, n in zip(CAUSES, self.loop.rejected, strict=True) if n}

    @property
    def flags(self) -> dict[str, int]:
        """Samples by flag; only flags that occurred."""
        counts = {flag.name: int(self.loop.flag_counts[int(flag).bit_length() - 1]) for flag in Flag}
        return {str(name).lower(): count for name, count in counts.items() if count}


def _terms(stack: Sequence[Model]) -> list[Any]:
    return [term for model in stack for term in model.terms]


def _thermal_key(term: Any) -> tuple[Any, ...]:
    """What the state of a term depends on; its coefficients do not matter, but for the Shupe term's."""
    names = TERMS[term.effect].names if term.effect in ("shupe", "unknown") else THERMAL_PARAMETERS
    return (term.effect, *(str(term.parameters.get(name)) for name in names))
