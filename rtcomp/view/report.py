"""Short texts beside the pictures."""

from collections.abc import Sequence

from rtcomp.model import Model, ResidualTable


def about_models(name: str, models: Sequence[Model]) -> str:
    """Markdown about a stack of models."""
    if not models:
        return f"## {name}\n\nNo model: rates pass through, flagged. Give one with `rtcomp run --model FILE`."
    return "\n\n".join([f"## {name}", *(_about(model) for model in models)])


def _about(model: Model) -> str:
    rows = [
        ("sensor", model.sensor or "not stated"),
        (
            "rules",
            f"{len(model.rules.centers)} over {', '.join(model.inputs)}" if model.rules.centers else "none",
        ),
        ("base", model.base.__class__.__name__ if model.base else "none"),
        ("terms", ", ".join(term.effect for term in model.terms) or "none"),
        *((f"valid {key}", f"{low:.4g} … {high:.4g}") for key, (low, high) in model.validity.items()),
        ("error left (σ)", _sigma(model)),
        *(
            (str(key), str(value))
            for key, value in model.provenance.items()
            if isinstance(value, str | int | float)
        ),
        ("sha256", f"{(model.sha256 or 'not sealed')[:16]}"),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in rows)])


def _sigma(model: Model) -> str:
    residual = model.residual_std_dps
    if residual is None:
        return "not stated"
    if isinstance(residual, ResidualTable):
        values = [value for row in residual.std_dps for value in row]
        return f"{min(values):.3g} … {max(values):.3g} °/s by region"
    return f"{residual:.3g} °/s"


def about_diagnosis(sentence: str, texts: Sequence[str]) -> str:
    """Markdown of a verdict and its findings."""
    return "\n".join([f"## {sentence}", "", *(f"- {text}" for text in texts)])
