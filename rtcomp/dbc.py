"""DBC files: parsed by cantools, compiled once into the rows that `rtcomp.decode` reads."""

from pathlib import Path
from typing import Any

import numpy as np

from rtcomp.decode import FLOAT16, FLOAT32, FLOAT64, PAYLOAD, SIGNAL, SIGNED, UNSIGNED, WORD
from rtcomp.errors import RequestError
from rtcomp.sources.python_can import import_can

FLOATS = {16: FLOAT16, 32: FLOAT32, 64: FLOAT64}
EXACT_BITS = 62


def load_dbc(path: str | Path) -> Any:
    """Parse a DBC file.

    Tried strictly first; a file whose signals overlap or leave their message is read too, as many in the field do.

    Raises RequestError naming the file and what is wrong with it.
    """
    import_can()  # cantools imports it too, but then with all that its readers need
    import cantools
    from cantools.database import UnsupportedDatabaseFormatError  # pyright: ignore[reportPrivateImportUsage]
    from cantools.database.errors import Error

    try:
        text = Path(path).read_text(encoding="cp1252", errors="replace")
    except OSError as error:
        raise RequestError(f"cannot read DBC {path}: {error.strerror}; give --dbc FILE") from error
    for strict in (True, False):
        try:
            return cantools.database.load_string(text, database_format="dbc", strict=strict)
        except (Error, UnsupportedDatabaseFormatError, ValueError, KeyError, TypeError) as error:
            if not strict:
                raise RequestError(f"{path}: not a DBC file cantools can read: {error}") from error
    raise AssertionError


def find_message(database: Any, message: str, where: str) -> Any:
    """The DBC's message of this name.

    Raises RequestError naming those it has.
    """
    found = [entry for entry in database.messages if entry.name == message]
    if not found:
        names = ", ".join(list(dict.fromkeys(entry.name for entry in database.messages))[:20])
        raise RequestError(f"{where}: the DBC has no message {message!r}; it has {names}")
    return found[0]


def find_signal(message: Any, signal: str, where: str) -> Any:
    """The message's signal of this name.

    Raises RequestError naming those it has.
    """
    found = [entry for entry in message.signals if entry.name == signal]
    if not found:
        names = ", ".join(entry.name for entry in message.signals)
        raise RequestError(f"{where}: message {message.name} has no signal {signal!r}; it has {names}")
    return found[0]


class SignalTable:
    """Collects signals and what they depend on; each (message, signal) gets one row."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []
        self._index: dict[tuple[Any, ...], int] = {}
        self._mux: list[tuple[int, int]] = []
        self._na: list[tuple[int, int]] = []

    def add(
        self,
        message_index: int,
        message: Any,
        signal: Any,
        factor: float = 1.0,
        shift_unit: float = 0.0,
        not_available: list[tuple[int, int]] | None = None,
    ) -> int:
        """Index of the row for `signal` of `message` (cantools objects), in units factor · DBC value + shift."""
        unavailable = tuple(not_available or ())
        key = (message_index, signal.name, factor, shift_unit, unavailable)
        if key in self._index:
            return self._index[key]
        selector, ranges = self._multiplexer(message_index, message, signal)
        row = layout(signal) | {
            "message": message_index,
            "multiplexer": selector,
            "mux_start": len(self._mux),
            "mux_count": len(ranges),
            "na_start": len(self._na),
            "na_count": len(unavailable),
            "factor": factor,
            "shift_unit": shift_unit,
        }
        self._mux.extend(ranges)
        self._na.extend(unavailable)
        self._rows.append(row)
        self._index[key] = len(self._rows) - 1
        return len(self._rows) - 1

    def _multiplexer(
        self, message_index: int, message: Any, signal: Any
    ) -> tuple[int, list[tuple[int, int]]]:
        if signal.multiplexer_signal is None or not signal.multiplexer_ids:
            return -1, []
        selector = find_signal(message, signal.multiplexer_signal, message.name)
        ranges = [(value, value) for value in signal.multiplexer_ids]
        return self.add(message_index, message, selector), ranges

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """SIGNAL rows, multiplexer ranges and not-available ranges (uint64, shape (n, 2))."""
        rows = np.zeros(len(self._rows), SIGNAL)
        for target, row in zip(rows, self._rows, strict=True):
            for name, value in row.items():
                target[name] = value
        pairs = [np.array(p, np.uint64).reshape(-1, 2) for p in (self._mux, self._na)]
        return rows, pairs[0], pairs[1]


def layout(signal: Any) -> dict[str, Any]:
    """Where a cantools signal's bits are, and how its raw value is scaled."""
    scale, offset = signal.conversion.scale, signal.conversion.offset
    if signal.byte_order == "little_endian":
        byte, shift, step = signal.start // 8, signal.start % 8, 1
    else:  # DBC counts from the most significant bit; the lowest is `length − 1` further in reading order
        lowest = signal.start // 8 * 8 + (7 - signal.start % 8) + signal.length - 1
        byte, shift, step = lowest // 8, 7 - lowest % 8, -1
    span = (shift + signal.length + 7) // 8
    first = byte if step > 0 else byte - span + 1
    one_word = first // WORD == (first + span - 1) // WORD
    kind = FLOATS[signal.length] if signal.conversion.is_float else (SIGNED if signal.is_signed else UNSIGNED)
    return {
        "byte": byte,
        "step": step,
        "shift": shift,
        "bits": signal.length,
        "word": (PAYLOAD + first) // WORD if one_word else -1,
        "word_shift": 8 * (first % WORD if step > 0 else WORD - 1 - byte % WORD) + shift,
        "kind": kind,
        "exact": 0 if signal.conversion.is_float else _exactness(signal.length, scale, offset),
        "scale": float(scale),
        "offset": float(offset),
    }


def _exactness(bits: int, scale: float, offset: float) -> int:
    """How far raw · scale + offset stays in int64, as cantools computes it in Python's integers (see SIGNAL)."""
    if not isinstance(scale, int) or abs(scale) >= 2**53 or bits + abs(scale).bit_length() > EXACT_BITS:
        return 0
    return 2 if isinstance(offset, int) and abs(offset) < 2**53 else 1
