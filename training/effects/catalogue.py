"""The one catalogue of effects, from which all take names, equations and units."""

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from rtcomp.errors import RequestError
from training.effects import chain, electronics, motion, noise, scale, thermal
from training.effects.alias import AliasClass, alias_classes_of
from training.effects.base import Effect

_IN_ORDER: tuple[type[Effect], ...] = (
    thermal.BiasTemperature,
    thermal.Shupe,
    thermal.ThermalLag,
    thermal.BiasHysteresis,
    thermal.PolarizationRipple,
    scale.ScaleTemperature,
    scale.ScaleNonlinearity,
    scale.ScaleHysteresis,
    scale.ScaleTemperatureRate,
    scale.ScaleAsymmetry,
    scale.SourceAgeing,
    noise.MultiplicativeNoise,
    electronics.DeadBand,
    electronics.Saturation,
    electronics.Bandwidth,
    electronics.Quantization,
    electronics.SupplyRipple,
    chain.TimestampSkew,
    chain.ClockDrift,
    chain.TimingJitter,
    chain.FrozenFrames,
    chain.DroppedFrames,
    chain.CounterWrap,
    electronics.UnitError,
    thermal.CompensationTable,
    electronics.AutoZero,
    thermal.BiasWarmup,
    scale.ScaleWarmup,
    noise.NoiseLevel,
    motion.BiasStep,
    scale.ScaleStep,
    motion.BiasDrift,
    motion.Acceleration,
    motion.VibrationRectification,
    motion.Misalignment,
    motion.EarthRate,
    motion.Magnetic,
    motion.TableEccentricity,
    scale.ScaleError,
    motion.BiasError,
)


@cache
def catalogue() -> Mapping[str, Effect]:
    """Return every effect by id, in the order of PHYSICS.md's sections A to G."""
    return MappingProxyType({kind.id: kind() for kind in _IN_ORDER})


def effect(effect_id: str) -> Effect:
    """Return one effect; RequestError lists the ids if there is none of that name."""
    try:
        return catalogue()[effect_id]
    except KeyError:
        raise RequestError(f"no effect {effect_id!r}; the catalogue has {', '.join(catalogue())}") from None


def alias_class(effect_id: str) -> tuple[AliasClass, ...]:
    """Return the alias classes of one effect, with the experiments that separate their members."""
    return alias_classes_of(effect(effect_id).id)
