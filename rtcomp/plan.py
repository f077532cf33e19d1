"""A signal map and its DBC, compiled into the arrays that the frame loop reads."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtcomp.dbc import SignalTable, find_message, find_signal, load_dbc
from rtcomp.errors import RequestError
from rtcomp.signal_map import (
    Channel,
    MessageRules,
    RateSignal,
    SignalMap,
    TemperatureSignal,
    dbc_path,
    quantum_warning,
    unavailable_from,
)
from rtcomp.units import rate_unit, temperature_unit

NO_E2E, PROFILE_1A, PROFILE_5, TOYOTA = range(4)
E2E_CODES = {"1A": PROFILE_1A, "5": PROFILE_5, "toyota": TOYOTA}
STANDARD_IDS = 2048
ALL_BITS = 0x1FFFFFFF
GAP_PERIODS = 3.0  # a rate frame later than this many expected periods is a gap
DLC_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)

MESSAGE = np.dtype(
    [
        ("can_id", "<u4"),
        ("mask", "<u4"),
        ("extended", "<i4"),
        ("length", "<i4"),
        ("frame_length", "<i4"),  # the length padded to what a CAN FD frame can have
        ("e2e", "<i4"),
        ("data_id", "<i4"),
        ("e2e_offset", "<i4"),
        ("counter", "<i4"),  # index of the counter's signal, −1: none
        ("modulus", "<i4"),
        ("max_step", "<i4"),
        ("first_use", "<u8"),  # rows of `uses`: what this message brings to which channel
        ("last_use", "<u8"),  # (one behind the last)
    ]
)
"""One message that carries something wanted, and what its frames must satisfy."""

USE = np.dtype([("channel", "<i4"), ("role", "<i4"), ("signal", "<i4")])
TEMPERATURE, COIL, REFERENCE, RATE = range(4)  # in the order in which one frame's signals are taken
"""What a signal is to a channel."""

CHANNEL = np.dtype(
    [
        ("valid", "<i4"),  # index of the status signal, −1: none
        ("ok_start", "<i4"),
        ("ok_count", "<i4"),
        ("range_dps", "<f8"),
        ("gap_ns", "<i8"),  # 0: no expectation
        ("max_age_ns", "<i8"),
        ("coil_max_age_ns", "<i8"),
        ("temp_slope", "<f8"),  # °C/s, °/s²: what is quicker is implausible (inf: nothing is)
        ("coil_slope", "<f8"),
        ("rate_slope", "<f8"),
        ("temp_stuck_ns", "<i8"),  # the same value for longer is stuck (0: never)
        ("coil_stuck_ns", "<i8"),
        ("rate_stuck_ns", "<i8"),
    ]
)
"""Limits of one channel."""


class Plan(NamedTuple):
    """The arrays of one map and DBC."""

    by_standard_id: np.ndarray  # int16 (2048): message of an 11-bit id, −1: none
    messages: np.ndarray  # MESSAGE
    uses: np.ndarray  # USE, those of one message together, sorted by role
    channels: np.ndarray  # CHANNEL
    signals: np.ndarray  # SIGNAL
    mux_ranges: np.ndarray  # uint64 (n, 2)
    na_ranges: np.ndarray  # uint64 (n, 2)
    ok_values: np.ndarray  # uint64
    scratch: np.ndarray  # uint8 (8)


class CompiledMap(NamedTuple):
    """A plan with what its numbers mean to a person."""

    plan: Plan
    signal_map: SignalMap
    channel_names: tuple[str, ...]
    warnings: tuple[str, ...]
    filters: tuple[tuple[int, int, bool], ...]  # (id, mask, extended) of every message wanted


def compile_map(signal_map: SignalMap, dbc: str | Path | None = None) -> CompiledMap:
    """Look up everything a map names in its DBC (or in `dbc`, which overrides it) and compile it.

    Raises RequestError for a message, signal or unit that is not there or does not fit.
    """
    database = load_dbc(dbc_path(signal_map, dbc))
    return _Compiler(signal_map, database).compile()


class _Compiler:
    def __init__(self, signal_map: SignalMap, database: Any) -> None:
        self.map, self.database = signal_map, database
        self.table = SignalTable()
        self.messages: list[Any] = []
        self.uses: list[tuple[int, int, int, int]] = []
        self.ok_values: list[int] = []
        self.warnings: list[str] = []

    def compile(self) -> CompiledMap:
        known = {entry.name for entry in self.database.messages}
        for rules in self.map.messages:
            if rules.name not in known:
                find_message(self.database, rules.name, f"map {self.map.title}")
        channels = np.array([self._channel(i, c) for i, c in enumerate(self.map.channels)], CHANNEL)
        self.uses.sort()
        messages = np.array([self._message(i, m) for i, m in enumerate(self.messages)], MESSAGE)
        self._check_ids(messages)
        signals, mux, unavailable = self.table.arrays()
        plan = Plan(
            self._standard_ids(messages),
            messages,
            np.array([use[2:3] + use[1:2] + use[3:] for use in self.uses], USE),
            channels,
            signals,
            mux,
            unavailable,
            np.array(self.ok_values, np.uint64),
            np.zeros(8, np.uint8),
        )
        names = tuple(channel.name for channel in self.map.channels)
        filters = tuple((int(m["can_id"]), int(m["mask"]), bool(m["extended"])) for m in messages)
        return CompiledMap(plan, self.map, names, tuple(self.warnings), filters)

    def _message_index(self, name: str, where: str) -> int:
        message = find_message(self.database, name, where)
        if message not in self.messages:
            self.messages.append(message)
        return self.messages.index(message)

    def _channel(self, index: int, channel: Channel) -> tuple[Any, ...]:
        where = f"channel {channel.name}"
        self._use(index, RATE, channel.rate, where)
        self._use(index, TEMPERATURE, channel.temperature, where)
        self._use(index, COIL, channel.coil_temperature, where)
        self._use(index, REFERENCE, channel.reference, where)
        rate = find_signal(
            find_message(self.database, channel.rate.message, where), channel.rate.signal, where
        )
        warning = quantum_warning(channel, float(rate.conversion.scale), channel.rate.unit or rate.unit)
        self.warnings += [warning] if warning else []
        start = len(self.ok_values)
        valid = -1
        if channel.valid is not None:
            message = self._message_index(channel.valid.message, where)
            signal = find_signal(self.messages[message], channel.valid.signal, where)
            valid = self.table.add(message, self.messages[message], signal)
            self.ok_values += channel.valid.ok
        return (
            valid,
            start,
            len(self.ok_values) - start,
            channel.range_dps or np.inf,
            round((channel.period_s or 0.0) * GAP_PERIODS * 1e9),
            _age_ns(channel.temperature),
            _age_ns(channel.coil_temperature),
            _slope(channel.temperature),
            _slope(channel.coil_temperature),
            channel.max_slope_dps_per_s or np.inf,
            _stuck_ns(channel.temperature),
            _stuck_ns(channel.coil_temperature),
            _stuck_ns(channel),
        )

    def _use(self, channel: int, role: int, spec: RateSignal | TemperatureSignal | None, where: str) -> None:
        if spec is None:
            return
        index = self._message_index(spec.message, where)
        message = self.messages[index]
        signal = find_signal(message, spec.signal, where)
        owner = f"{where}: signal {spec.message}.{spec.signal}"
        if isinstance(spec, RateSignal):
            unit, sign = rate_unit(spec.unit or signal.unit, owner), spec.sign
        else:
            unit, sign = temperature_unit(spec.unit or signal.unit, owner), 1
        row = self.table.add(
            index,
            message,
            signal,
            sign * unit.factor,
            sign * unit.offset,
            _unavailable(spec.not_available, signal),
        )
        self.uses.append((index, role, channel, row))

    def _message(self, index: int, message: Any) -> tuple[Any, ...]:
        rules = next((r for r in self.map.messages if r.name == message.name), MessageRules(message.name))
        rows = [k for k, use in enumerate(self.uses) if use[0] == index]
        counter = -1
        if rules.counter is not None:
            counter = self.table.add(index, message, find_signal(message, rules.counter.signal, message.name))
        can_id, mask = _match(message, rules)
        return (
            can_id,
            mask,
            int(message.is_extended_frame),
            message.length,
            next(length for length in DLC_LENGTHS if length >= message.length),
            E2E_CODES[rules.e2e.profile] if rules.e2e else NO_E2E,
            (rules.e2e.data_id or 0) if rules.e2e else 0,
            rules.e2e.offset if rules.e2e else 0,
            counter,
            rules.counter.modulus if rules.counter else 0,
            rules.counter.max_step if rules.counter else 0,
            rows[0] if rows else 0,
            rows[0] + len(rows) if rows else 0,
        )

    def _check_ids(self, messages: np.ndarray) -> None:
        seen: dict[tuple[int, int], str] = {}
        for row, message in zip(messages, self.messages, strict=True):
            key = (int(row["can_id"]), int(row["extended"]))
            if key in seen:
                raise RequestError(
                    f"messages {seen[key]} and {message.name} have one CAN id 0x{key[0]:X}; keep one"
                )
            seen[key] = message.name

    @staticmethod
    def _standard_ids(messages: np.ndarray) -> np.ndarray:
        table = np.full(STANDARD_IDS, -1, np.int16)
        for index, message in enumerate(messages):
            if not message["extended"]:
                table[message["can_id"]] = index
        return table


def _age_ns(spec: TemperatureSignal | None) -> int:
    return round(spec.max_age_s * 1e9) if spec else 0


def _slope(spec: TemperatureSignal | None) -> float:
    return (spec.max_rate_degC_per_s if spec else None) or np.inf


def _stuck_ns(spec: TemperatureSignal | Channel | None) -> int:
    return round(((spec.stuck_after_s if spec else None) or 0.0) * 1e9)


def _match(message: Any, rules: MessageRules) -> tuple[int, int]:
    """Id and mask; a J1939 parameter group is told by its PGN, whatever the priority and (unless given) the source."""
    can_id = message.frame_id
    if rules.match == "id":
        return can_id, ALL_BITS
    if not message.is_extended_frame:
        raise RequestError(
            f'message {message.name}: match = "pgn" needs a 29-bit id, the DBC has 0x{can_id:X}'
        )
    pdu2 = (can_id >> 16) & 0xFF >= 240  # below, the next byte is a destination and no part of the PGN
    mask = 0x03FFFF00 if pdu2 else 0x03FF0000
    if rules.source_address is not None:
        can_id, mask = can_id & ~0xFF | rules.source_address, mask | 0xFF
    return can_id & mask, mask


def _unavailable(spec: Any, signal: Any) -> list[tuple[int, int]]:
    """Raw ranges (unsigned) that mean "no value"."""
    top = (1 << signal.length) - 1
    if spec == "j1939":
        return [(unavailable_from(signal.length), top)]
    for value in spec:
        low = -(1 << (signal.length - 1)) if signal.is_signed else 0
        if not low <= value <= top:
            raise RequestError(
                f"signal {signal.name}: not_available {value} does not fit {signal.length} bits"
            )
    return [(value & top, value & top) for value in spec]
