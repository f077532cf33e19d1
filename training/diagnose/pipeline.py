"""The stages in order: integrity, intake, noise, locate, name, model, prove, verdict."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from rtcomp.errors import RequestError
from training.diagnose.align import common
from training.diagnose.checked import Checked
from training.diagnose.classes import apart, demoted, preferred
from training.diagnose.design import Domain, Frame, Library, domain
from training.diagnose.generic import generic_groups
from training.diagnose.groups import GROUPS
from training.diagnose.intake import Intake, checked_recording, fast_findings, take_in
from training.diagnose.library import Survey
from training.diagnose.naming import Model, build, forward, leading
from training.diagnose.prepare import survey
from training.diagnose.prove import Proof, folded, placebo, predicted, prove
from training.diagnose.search import Null, surrogate_null
from training.diagnose.settings import Settings
from training.diagnose.simulation import Simulation
from training.diagnose.surface import Surface, fit_surface
from training.diagnose.unknown import (
    Located,
    Unknown,
    empirical,
    locate,
    located_by_shape,
    ranked,
    unexplained,
)
from training.table import Recording

logger = logging.getLogger(__name__)
MIN_BLOCKS = 24
FOLLOWING = frozenset({"multiplicative_noise", "timing_jitter"})
WAKE = 0.015  # of a named error's size, below which a noise that follows the motion is only what that leaves
Progress = Callable[[str], None]


@dataclass
class Analysis:
    """Everything the stages found, before it is put into words."""

    settings: Settings
    simulation: Simulation
    intakes: list[Intake]
    heldout: list[Intake]
    survey: Survey | None = None
    domains: list[Domain] = field(default_factory=list)
    library: Library | None = None
    null: Null | None = None
    model: Model | None = None
    base: Model | None = None
    demoted: list[str] = field(default_factory=list)
    located: list[Located] = field(default_factory=list)
    unknown: Unknown | None = None
    surface: Surface | None = None
    proofs: list[Proof] = field(default_factory=list)
    placebo: float | None = None
    unusable: list[tuple[Recording, Checked]] = field(default_factory=list)
    unusable_heldout: list[tuple[Recording, Checked]] = field(default_factory=list)

    def everything(self) -> Model | None:
        """The named parts and, where something without a name was found, its empirical part: all that is told."""
        if self.model is None or self.unknown is None or not self.unknown.named:
            return self.model
        return empirical(self.unknown, self.domains, self.model)


def analyse(
    recordings: Sequence[Recording],
    heldout: Sequence[Recording],
    simulation: Simulation,
    settings: Settings,
    progress: Progress = lambda stage: None,
) -> Analysis:
    """Run every stage; held-out recordings are touched only by the proof."""
    progress("integrity")
    checked = [(r, checked_recording(r, settings.static)) for r in recordings]
    unusable = [(r, c) for r, c in checked if c.unusable]
    usable = [(r, c) for r, c in checked if not c.unusable]
    kinds = {"t_s" in c.columns for _, c in usable}
    if len(kinds) > 1:
        raise RequestError(
            "some recordings have t_s and others not; diagnose soaked points and time series apart"
        )
    progress("align")
    intakes = [take_in(r, c, simulation, settings) for r, c in usable]
    analysis = Analysis(settings, simulation, intakes, [], unusable=unusable)
    analysis.surface = fit_surface([intake.simulated_error for intake in intakes])
    for intake in intakes:
        intake.stand_on(analysis.surface)
    if not intakes or max(len(i.work) for i in intakes) < MIN_BLOCKS:
        return analysis
    _search(analysis, progress)
    progress("prove")
    _prove(analysis, heldout)
    return analysis


def _search(analysis: Analysis, progress: Progress) -> None:
    settings = analysis.settings
    works = [i.work for i in analysis.intakes]
    for index, work in enumerate(works):
        work.index = index
    progress("noise")
    analysis.survey = found = survey(works)
    analysis.domains = domains = [domain(w) for w in works]
    base = build([], domains)
    analysis.base = base
    groups = [g for g in GROUPS if g.needs <= found.has and g.effect not in settings.left_out]
    if not groups:
        analysis.model = base
        return
    library = analysis.library = Library(domains, groups, found)
    if not library.variants:
        analysis.model, analysis.library = base, None
        return
    null = analysis.null = surrogate_null(
        library, domains, base.fit, settings.seed, count=settings.surrogates
    )
    lead = leading(library, domains, null)
    if lead is not None:  # beside something this large the first noise was none
        null = analysis.null = surrogate_null(
            library, domains, lead.fit, settings.seed, count=settings.surrogates
        )
    progress("locate")
    generic = Library(domains, [g for g in generic_groups(works) if g.needs <= found.has], found)
    by_function, generic_null = locate(generic, domains, base, lead or base, settings.seed + 1)
    analysis.located = ranked([*by_function, *located_by_shape(library, base, null)])
    progress("name")
    names = partial(_names, library, null, analysis.simulation.kind == "model")
    model, analysis.demoted = names(domains)
    analysis.model, analysis.unknown = unexplained(
        generic, domains, model, generic_null, analysis.demoted, lambda beside: names(beside)[0]
    )
    for intake in analysis.intakes:
        _confirm(intake, analysis)


def _confirm(intake: Intake, analysis: Analysis) -> None:
    """Keep what was said of the noise only if it still shows without what was named: a large error passes for noise.

    What is small beside the named error is no more than what a noisy temperature or an inexact shape leaves of it.
    """
    model = analysis.everything()
    if model is None or not model.parts or not intake.fast:
        return
    wave = predicted(model, intake, analysis.settings.power_on_known) - intake.timing_change
    least = WAKE * float(np.std(wave))
    again = {f.effect for f in fast_findings(intake, wave) if f.effect not in FOLLOWING or f.rms_dps > least}
    intake.fast = [f for f in intake.fast if f.effect in again]


def _names(library: Library, null: Null, trained: bool, domains: Sequence[Domain]) -> tuple[Model, list[str]]:
    """(the named model with its classes, names demoted on the way)."""
    chosen = apart(library, domains, null, forward(library, domains, null))
    model, dropped = demoted(chosen, domains, trained)
    return preferred(library, domains, null, model), dropped


def _prove(analysis: Analysis, heldout: Sequence[Recording]) -> None:
    settings, model = analysis.settings, analysis.everything()
    if model is None:
        return
    if heldout:
        shared = common([intake.timing for intake in analysis.intakes])
        for recording in heldout:
            checked = checked_recording(recording, settings.static)
            if checked.unusable:
                analysis.unusable_heldout.append((recording, checked))
                continue
            intake = take_in(recording, checked, analysis.simulation, settings, shared)
            intake.stand_on(analysis.surface)
            analysis.heldout.append(intake)
    if analysis.heldout:
        for intake in analysis.heldout:
            wave = predicted(model, intake, settings.power_on_known)
            analysis.proofs.append(prove(intake, wave, settings.power_on_known))
    else:
        analysis.proofs = folded(model, analysis.intakes, settings.power_on_known)
    analysis.placebo = placebo(model, analysis.intakes, analysis.proofs, analysis.domains)


def residual_after(analysis: Analysis, index: int) -> np.ndarray:
    """Block residual of recording `index` after the model [dps], its own offset and scale removed."""
    from training.diagnose.prove import cleared
    from training.diagnose.refit import waveform

    work = analysis.intakes[index].work
    left = work.y.copy()
    model = analysis.everything()
    if model is not None:
        for part, where in zip(model.parts, model.slices(), strict=True):
            left = left - waveform(part, model.fit.beta[where], work)
    return cleared(left, work.w, np.ones(len(left), bool))


__all__ = ["Analysis", "Frame", "analyse", "residual_after"]
