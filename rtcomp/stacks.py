"""The model files of a run, read into a stack per channel."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtcomp.errors import RequestError
from rtcomp.model import Model, check_sensor, load_model


def load_stacks(
    models: list[str], names: tuple[str, ...], sensor: str | None, trust: Sequence[Any] = ()
) -> dict[str, list[Model]]:
    """Read `FILE` (for every channel) and `CHANNEL=FILE` into a stack per channel.

    Raises RequestError for a channel the map does not have, a model of another sensor, or one signed by none of
    the public keys in `trust` (where there are any).
    """
    stacks: dict[str, list[Model]] = {}
    for item in models:
        channel, separator, path = item.partition("=")
        if not separator or channel not in names:
            if separator and not Path(item).exists():
                raise RequestError(
                    f"--model {item}: the map has no channel {channel!r}, only {', '.join(names)}"
                )
            channel, path = "", item
        model = load_model(path, trust)
        check_sensor(model, sensor, path)
        for name in [channel] if channel else names:
            stacks.setdefault(name, []).append(model)
    return stacks


def trusted_keys(paths: list[str]) -> Sequence[Any]:
    """The keys to hold models to; cryptography is loaded only where there are any."""
    if not paths:
        return ()
    from rtcomp.signing import load_public_keys

    return load_public_keys(paths)
