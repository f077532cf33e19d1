"""What the user may set, and the thresholds of the verdict with the reason of each."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Options of one diagnosis.

    `offset_tol_dps` and `scale_tol_ppm` say from which size a recording's own offset and scale factor are findings;
    below them they are nuisance.
    """

    static: bool = False
    power_on_known: bool = True
    offset_tol_dps: float = 0.5
    scale_tol_ppm: float = 10_000.0
    seed: int = 20_240_501
    surrogates: int = 48
    left_out: frozenset[str] = frozenset()
