"""A finding under a name of the catalogue: its class, and the recording that would separate it."""

from collections.abc import Sequence

from training.diagnose.document import Finding
from training.effects.alias import ALIAS_CLASSES
from training.effects.catalogue import effect


def separate_by(name: str, others: Sequence[str]) -> str:
    """The recording that would tell `name` from the others."""
    texts = [c.separate_by for c in ALIAS_CLASSES if name in c.members and set(others) & set(c.members)]
    return "; or ".join(dict.fromkeys(texts)) if texts else effect(name).excitation


def named(name: str, others: Sequence[str], **rest: object) -> Finding:
    """A finding under a name, with the `others` that these recordings cannot tell from it; `rest` as in Finding."""
    ordered = [name, *[o for o in others if o != name]]
    status = "named" if len(ordered) == 1 else "ambiguous"
    drivers = effect(name).drivers
    return Finding(
        effect=name,
        status=status,
        alternatives=ordered,
        separate_by=None if status == "named" else separate_by(name, ordered[1:]),
        driver=str(rest.pop("driver", drivers[0] if drivers else "time")),
        **rest,  # type: ignore[arg-type]
    )
