"""A model file for a person."""

from typing import Any

from rtcomp.errors import printable
from rtcomp.model import Model, ResidualTable
from rtcomp.terms import TERMS


def describe_model(model: Model, name: str) -> None:
    """Print what a model holds on standard output."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    facts = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for key, value in model_facts(model):
        facts.add_row(Text(printable(key), "bold"), Text(printable(value)))  # as it is, no markup of rich's
    console.print(Text(f"{printable(name)}: a valid model"), facts, sep="\n")
    if model.rules.centers:
        console.print(_rules_table(model))


def model_facts(model: Model) -> list[tuple[str, str]]:
    """Name and value of everything but the rules."""
    seal = f"sealed, {model.sha256[:12]}…" if model.sha256 else "not sealed (`rtcomp model FILE --seal`)"
    signed = "signed" if model.signature else "not signed"
    return [
        ("inputs", ", ".join(model.inputs) or "none"),
        ("rules", str(len(model.rules.centers))),
        ("base", type(model.base).__name__ if model.base else "none"),
        *((f"term {term.effect}", _parameters(term)) for term in model.terms),
        ("valid for", ", ".join(f"{k} {a:g} … {b:g}" for k, (a, b) in model.validity.items()) or "anything"),
        ("residual std", _residual(model)),
        ("sensor", model.sensor or "any"),
        *((f"from {key}", str(value)) for key, value in model.provenance.items()),
        ("integrity", f"{seal}; {signed}"),
    ]


def _parameters(term: Any) -> str:
    listed = ", ".join(f"{key} = {value}" for key, value in term.parameters.items())
    return f"{listed}   ({TERMS[term.effect].equation})"


def _residual(model: Model) -> str:
    residual = model.residual_std_dps
    if residual is None:
        return "not stated"
    if isinstance(residual, ResidualTable):
        values = [value for row in residual.std_dps for value in row]
        return f"{min(values):.3g} … {max(values):.3g} °/s in {len(values)} regions"
    return f"{residual:.4g} °/s"


def _rules_table(model: Model) -> Any:
    from rich.table import Table

    table = Table(
        "rule", *(f"{name}: centre ± width" for name in model.inputs), "error [°/s] =", title_justify="left"
    )
    rules = model.rules
    for j, (center, width, row) in enumerate(
        zip(rules.centers, rules.widths, rules.consequents, strict=True), 1
    ):
        sets = [f"{v:.4g} ± {s:.4g}" for v, s in zip(center, width, strict=True)]
        output = f"{row[0]:.4g} " + " ".join(
            f"{a:+.4g}·{n}" for a, n in zip(row[1:], model.inputs, strict=True)
        )
        table.add_row(str(j), *sets, output)
    return table
