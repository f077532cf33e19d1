"""What a publisher tells on request: the layout of its samples and the models they were corrected with."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from rtcomp.errors import WorkError
from rtcomp.frames import CORRECTED
from rtcomp.model import Model, parse_model

ANSWER_S = 1.0


def ask(session: Any, key: str) -> Any:
    """The JSON document that answers `key`; None where nobody does within `ANSWER_S`.

    Raises WorkError when the answer is not JSON.
    """
    for reply in session.get(key, timeout=ANSWER_S):
        if reply.ok is not None:
            return read_document(reply.ok.payload.to_bytes(), key)
    return None


def read_document(payload: bytes, key: str) -> Any:
    """The JSON document that came under `key`.

    Raises WorkError when it is none.
    """
    try:
        return json.loads(payload)
    except ValueError as error:
        raise WorkError(f"{key} says what is not JSON ({error}); is it another program's key?") from error


def sample_layout(session: Any, channel_key: str) -> np.dtype[Any] | None:
    """The sample's layout as `…/schema` states it; None where nobody answers.

    Raises WorkError for a schema that cannot be read, or that lacks what the viewer shows.
    """
    schema = ask(session, f"{channel_key}/schema")
    if schema is None:
        return None
    try:
        names, formats, offsets = zip(*schema["fields"], strict=True)
        layout = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": schema["size"]}
        )
    except (KeyError, TypeError, ValueError) as error:
        raise WorkError(
            f"{channel_key}/schema is not a sample's layout ({error!r}); wanted rtcomp.corrected/1"
        ) from error
    missing = set(CORRECTED.names or ()) - set(names)
    if missing:
        raise WorkError(
            f"{channel_key}/schema lacks {', '.join(sorted(missing))}; publisher and viewer differ in version"
        )
    return layout


def active_models(session: Any, channel_key: str) -> Sequence[Model]:
    """The models in use, in their order; none where nobody answers or none is active."""
    answer = ask(session, f"{channel_key}/model")
    documents = answer if isinstance(answer, list) else [answer]
    return [parse_model(json.dumps(document), f"{channel_key}/model") for document in documents if document]
