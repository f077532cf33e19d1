"""The model file: strict JSON, versioned, sealed by a hash, never a pickle (layout: `Model`)."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from rtcomp.atomic import write_atomically
from rtcomp.errors import RequestError

SCHEMA = "rtcomp.model/1"
INPUTS = (
    "temp_degC",
    "rate_dps",
    "coil_temp_degC",
    "temp_rate_degC_per_s",
    "lag_temp_degC",
    "time_since_power_on_s",
)
"""What a rule may depend on, in the order in which the compiled step holds them."""
MAX_INPUTS = 4
MAX_RULES = 1024
MAX_TERMS = 256
MAX_TABLE = 4096  # numbers of one table: polynomial coefficients, knots, residual regions
MAX_BYTES = 16 * 2**20
MAX_DEPTH = 32  # of nested JSON; rules need four, a provenance some more
NOT_HASHED = ("sha256", "signature")


class Strict(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Base of every part: unknown keys are refused."""


class Rules(Strict, frozen=True):
    """TS rules (PAPER eqs. 1, 2, 9-11): `centers` and `widths` (σ) c × n, `consequents` c × (n + 1)."""

    centers: list[list[float]] = []
    widths: list[list[float]] = []
    consequents: list[list[float]] = []


class OpenLoopSine(Strict, frozen=True, tag="open_loop_sine", tag_field="kind"):
    """m = G sin(K ω)/K0 with K = K0 (1 + αh), G = 1 + g0 + g1 h + g2 h², h = T − ref; ω in rad/s inside."""

    K0_s: float
    alpha_per_K: float = 0.0
    g0: float = 0.0
    g1_per_K: float = 0.0
    g2_per_K2: float = 0.0
    ref_degC: float = 25.0


class Polynomial(Strict, frozen=True, tag="polynomial", tag_field="kind"):
    """Error = Σ c[i][j] hⁱ mʲ with h = T − ref and m the measured rate [°/s]."""

    coefficients: list[list[float]]
    ref_degC: float = 25.0


class Term(Strict, frozen=True):
    """One dynamic effect; names, units and equations of its parameters are in `rtcomp.terms`."""

    effect: str
    parameters: dict[str, bool | float | list[float] | str]


class ResidualTable(Strict, frozen=True):
    """Residual standard deviation [°/s] per region: edges of temperature and rate, `std_dps` rows by temperature."""

    temp_degC: list[float]
    rate_dps: list[float]
    std_dps: list[list[float]]


class Model(Strict, frozen=True):
    """A model file. Predicted error = base + TS part + terms [°/s]; corrected = raw − predicted."""

    schema: Literal["rtcomp.model/1"]
    inputs: list[str]
    rules: Rules
    base: OpenLoopSine | Polynomial | None = None
    terms: list[Term] = []
    validity: dict[str, tuple[float, float]] = {}
    residual_std_dps: float | ResidualTable | None = None
    sensor: str | None = None
    provenance: dict[str, Any] = {}
    filters: dict[str, float] = {}
    signature: str | None = None
    sha256: str | None = None


def new_model(**fields: Any) -> Model:
    """Make a checked model from its fields; `schema` is filled in.

    Raises RequestError on anything a model file would be refused for.
    """
    model = Model(**({"schema": SCHEMA, "inputs": [], "rules": Rules()} | fields))
    return parse_model(json.dumps(msgspec.to_builtins(model)), "model")


def load_model(path: str | Path, trust: Sequence[Any] = ()) -> Model:
    """Read and check a model file; with `trust` (public keys) only one that is signed by one of them.

    Raises RequestError naming the file and the reason.
    """
    return parse_model(_read(Path(path)), str(path), trust)


def read_document(path: str | Path) -> dict[str, Any]:
    """A model file's JSON object, not yet checked for what is in it."""
    return _parse_json(_read(Path(path)), str(path))


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise RequestError(f"{path}: a model of more than {MAX_BYTES} bytes; at most that are read")
        return content.decode()
    except OSError as error:
        raise RequestError(
            f"cannot read model {path}: {error.strerror}; give the path of a model file"
        ) from error
    except UnicodeDecodeError as error:
        raise RequestError(f"{path}: not UTF-8 text; a model file is JSON (see `rtcomp train`)") from error


def parse_model(text: str, name: str, trust: Sequence[Any] = ()) -> Model:
    """Check the text of a model file; `name` goes into messages, `trust` are the public keys it is held to."""
    from rtcomp.model_checks import check_model

    document = _parse_json(text, name)
    version = document.get("schema")
    if version != SCHEMA:
        raise RequestError(f"{name}: schema is {version!r}, this version reads {SCHEMA!r}; train it again")
    try:
        model = msgspec.convert(document, Model)
    except msgspec.ValidationError as error:
        raise RequestError(f"{name}: {error}; see the model file's layout in the README") from error
    if model.sha256 is not None and model.sha256 != document_hash(document):
        raise RequestError(
            f"{name}: sha256 does not match its contents, the file was changed after sealing; "
            f"restore it, or `rtcomp model {name} --seal` if the change is meant"
        )
    if trust:
        from rtcomp.signing import check_signature

        check_signature(canonical(document), model.signature, trust, name)
    check_model(model, name)
    return model


def check_sensor(model: Model, sensor: str | None, name: str) -> None:
    """Refuse a model of another sensor than the one that is stated.

    Raises RequestError naming both.
    """
    if sensor is not None and model.sensor is not None and model.sensor != sensor:
        raise RequestError(
            f"{name} is a model of sensor {model.sensor}, but this is {sensor}; use its own model"
        )


def document_hash(document: dict[str, Any]) -> str:
    """SHA-256 over the canonical JSON (sorted keys, no spaces, ASCII) without `sha256` and `signature`."""
    return hashlib.sha256(canonical(document)).hexdigest()


def canonical(document: dict[str, Any]) -> bytes:
    """The bytes that are hashed and signed."""
    kept = {key: value for key, value in document.items() if key not in NOT_HASHED}
    return json.dumps(kept, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def model_document(model: Model) -> dict[str, Any]:
    """The model as plain JSON values, sealed with its hash."""
    document = msgspec.to_builtins(model)
    if document["signature"] is None:
        del document["signature"]
    return document | {"sha256": document_hash(document)}


def seal_model(path: str | Path) -> Model:
    """Write the hash of a file's contents into it, whatever hash it had; returns the checked model.

    Raises RequestError for anything that is not a model.
    """
    return write_sealed(read_document(path), path)


def write_sealed(document: dict[str, Any], path: str | Path, **marks: str) -> Model:
    """Write a model's document with its hash and other `marks` (a signature) in place of what it had."""
    sealed = {key: value for key, value in document.items() if key not in NOT_HASHED}
    sealed |= {"sha256": document_hash(document)} | marks
    model = parse_model(json.dumps(sealed), str(path))
    write_document(sealed, path)
    return model


def save_model(model: Model, path: str | Path) -> None:
    """Seal the model and write it atomically."""
    write_document(model_document(model), path)


def write_document(document: dict[str, Any], path: str | Path) -> None:
    """Write a JSON document: whole or not at all."""
    write_atomically(
        path, (json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode()
    )


def _parse_json(text: str, name: str) -> dict[str, Any]:
    try:
        document = json.loads(text, object_pairs_hook=_unique_keys, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise RequestError(f"{name}: not a model file: {error}") from error
    if not isinstance(document, dict):
        raise RequestError(
            f"{name}: got a JSON {type(document).__name__}, wanted an object with schema {SCHEMA!r}"
        )
    _check_depth(document, name)
    return document


def _check_depth(document: Any, name: str) -> None:
    """What can just be read may be too deep to be written again, by a thread that must not fail."""
    level = [document]
    for _ in range(MAX_DEPTH):
        children = (child for item in level for child in (item.values() if isinstance(item, dict) else item))
        level = [child for child in children if isinstance(child, dict | list)]
        if not level:
            return
    raise RequestError(
        f"{name}: nested more than {MAX_DEPTH} deep; a model is a few levels of objects and lists"
    )


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    document = dict(pairs)
    if len(document) != len(pairs):
        raise ValueError("a key stands twice in one object")
    return document


def _refuse_constant(constant: str) -> None:
    raise ValueError(f"{constant} is not a finite number")
