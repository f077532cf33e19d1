"""Model files: what is written is read back, what is wrong is refused with its reason."""

import contextlib
import hashlib
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcomp.errors import RequestError
from rtcomp.model import load_model, model_document, new_model, parse_model, save_model, seal_model
from rtcomp.terms import TERMS

MINIMAL = {
    "schema": "rtcomp.model/1",
    "inputs": [],
    "rules": {"centers": [], "widths": [], "consequents": []},
}


LEAVES = st.none() | st.booleans() | st.floats() | st.text(max_size=8)
KEYS = st.sampled_from([*MINIMAL, "base", "terms", "kind", "effect"])
ANY_JSON = st.recursive(LEAVES, lambda c: st.lists(c) | st.dictionaries(KEYS, c), max_leaves=12)


def text(**changes):
    return json.dumps(MINIMAL | changes)


def test_what_is_saved_is_loaded_and_sealed(tmp_path, lag_model):
    path = tmp_path / "model.json"
    save_model(lag_model, path)
    loaded = load_model(path)
    assert model_document(loaded) == model_document(lag_model)
    document = json.loads(path.read_text())
    kept = {key: value for key, value in document.items() if key != "sha256"}
    canonical = json.dumps(kept, sort_keys=True, separators=(",", ":")).encode()
    assert document["sha256"] == hashlib.sha256(canonical).hexdigest()


def test_a_changed_model_is_refused_until_it_is_sealed_again(tmp_path, ts_model):
    path = tmp_path / "model.json"
    save_model(ts_model, path)
    document = json.loads(path.read_text()) | {"residual_std_dps": 0.5}
    path.write_text(json.dumps(document))
    with pytest.raises(RequestError, match="sha256 does not match"):
        load_model(path)
    assert seal_model(path).residual_std_dps == 0.5
    assert load_model(path).residual_std_dps == 0.5


def test_integers_of_a_hand_written_model_seal_as_they_stand(tmp_path):
    path = tmp_path / "model.json"
    path.write_text(text(residual_std_dps=1))
    assert seal_model(path).residual_std_dps == 1
    assert load_model(path).sha256


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("not json", "not a model file"),
        ("[1]", "wanted an object"),
        (text(schema="rtcomp.model/2"), "schema is 'rtcomp.model/2'"),
        (text(unexpected=1), "unexpected"),
        (text(inputs=["temperature"]), "unknown input 'temperature'"),
        (text(residual_std_dps=-1.0), "not negative"),
        (text(validity={"temp_degC": [5.0, -5.0]}), "low must not exceed"),
        (text(filters={"lag_temp_degC": 0.0}), "above 0 s"),
        (text(terms=[{"effect": "magic", "parameters": {}}]), "no runtime term"),
        (text(terms=[{"effect": "thermal_lag", "parameters": {}}]), "missing \\['tau_s'\\]"),
        (text(terms=[{"effect": "thermal_lag", "parameters": {"tau_s": -1.0}}]), "must be above 0"),
        (text(terms=[{"effect": "bias_error", "parameters": {"dps": "much"}}]), "wanted a number"),
        (text(base={"kind": "spline"}), "kind"),
        (text(rules={"centers": [[1.0]], "widths": [[1.0]], "consequents": [[0.0, 0.0]]}), "inputs"),
        ('{"schema": "rtcomp.model/1", "schema": "rtcomp.model/1"}', "twice"),
        (text().replace("[]", "[NaN]", 1), "NaN"),
        (text(residual_std_dps=0).replace("0}", "1e999}"), "finite"),
        ("[" * 100_000, "not a model file"),
    ],
)
def test_what_is_wrong_is_refused_with_its_reason(content, reason):
    with pytest.raises(RequestError, match=reason):
        parse_model(content, "model.json")


def test_wrong_shapes_and_widths_are_refused(ts_model):
    document = model_document(ts_model)
    del document["sha256"]
    document["rules"]["widths"][0][0] = 0.0
    with pytest.raises(RequestError, match="widths must all be above 0"):
        parse_model(json.dumps(document), "m")
    document["rules"]["widths"].pop()
    with pytest.raises(RequestError, match=r"rules\.widths has 3 rows"):
        parse_model(json.dumps(document), "m")


def test_a_model_is_written_whole_or_not_at_all(tmp_path, ts_model):
    with pytest.raises(RequestError, match="folder that exists"):
        save_model(ts_model, tmp_path / "absent" / "model.json")
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=200)
@given(ANY_JSON)
def test_any_json_is_a_model_or_a_request_error(value):
    document = MINIMAL | value if isinstance(value, dict) else value
    with contextlib.suppress(RequestError):  # and nothing else
        parse_model(json.dumps(document), "fuzz")


@pytest.mark.parametrize("effect", [name for name in TERMS if name != "unknown"])
def test_every_term_can_stand_in_a_model(effect):
    parameters = dict.fromkeys(TERMS[effect].names, 1.5)
    model = new_model(terms=[{"effect": effect, "parameters": parameters}])
    assert model.terms[0].parameters == parameters
