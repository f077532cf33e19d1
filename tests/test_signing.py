"""Signed models: only those of trusted keys run, whatever way they come."""

import base64
import json
import stat

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.rsa import generate_private_key

from rtcomp.cli import main
from rtcomp.config import RunConfig
from rtcomp.errors import RequestError
from rtcomp.model import canonical, load_model, model_document, parse_model, save_model
from rtcomp.run import Runner, load_stacks
from rtcomp.signing import load_private_key, load_public_keys, new_key, sign_model


@pytest.fixture
def keys(tmp_path):
    """Key files of who is trusted and of a stranger."""
    return new_key(tmp_path / "fleet.key")[0], new_key(tmp_path / "stranger.key")[0]


@pytest.fixture
def model_path(tmp_path, lag_model):
    save_model(lag_model, tmp_path / "model.json")
    return tmp_path / "model.json"


def public(key):
    return load_public_keys([f"{key}.pub"])


def test_a_signed_model_is_taken_by_who_trusts_its_key_and_by_nobody_else(keys, model_path, lag_model):
    ours, stranger = keys
    sign_model(model_path, ours)
    signed = load_model(model_path, public(ours))
    assert signed.rules == lag_model.rules
    assert load_model(model_path, (*public(stranger), *public(ours))) == signed
    assert load_model(model_path) == signed  # without --trust a signature is no condition
    with pytest.raises(RequestError, match="none of the 1 trusted keys"):
        load_model(model_path, public(stranger))


def test_the_signature_is_ed25519_over_the_canonical_document(keys, model_path):
    sign_model(model_path, keys[0])
    document = json.loads(model_path.read_text())
    key = serialization.load_pem_public_key((model_path.parent / "fleet.key.pub").read_bytes())
    kept = {name: value for name, value in document.items() if name not in ("sha256", "signature")}
    text = json.dumps(kept, sort_keys=True, separators=(",", ":")).encode()
    assert text == canonical(document)
    key.verify(base64.b64decode(document["signature"]), text)  # raises when it is not


def test_layout_does_not_matter_and_every_number_does(keys, model_path):
    sign_model(model_path, keys[0])
    document = json.loads(model_path.read_text())
    reversed_keys = dict(reversed(document.items()))
    assert parse_model(json.dumps(reversed_keys, indent=3), "m", public(keys[0]))
    changed = {
        name: value for name, value in document.items() if name != "sha256"
    }  # an attacker can drop the hash
    changed["terms"] = [
        {"effect": "thermal_lag", "parameters": {"tau_s": 280.0, "scale_ppm_per_K": -1263.0000001}}
    ]
    assert parse_model(json.dumps(changed), "m")
    with pytest.raises(RequestError, match="changed after signing"):
        parse_model(json.dumps(changed), "m", public(keys[0]))


@pytest.mark.parametrize("signature", [None, "", "!", "AAAA", base64.b64encode(bytes(64)).decode(), "ü" * 88])
def test_no_or_a_made_up_signature_is_refused(keys, model_path, signature):
    document = json.loads(model_path.read_text())
    if signature is not None:
        document["signature"] = signature
    with pytest.raises(RequestError, match=r"signed|signature"):
        parse_model(json.dumps(document), "m", public(keys[0]))


def test_sealing_takes_a_signature_off(keys, model_path):
    from rtcomp.model import seal_model

    sign_model(model_path, keys[0])
    assert seal_model(model_path).signature is None


def test_key_files_are_private_never_overwritten_and_told_apart(tmp_path, keys):
    ours = keys[0]
    assert stat.S_IMODE(ours.stat().st_mode) == 0o600
    before = ours.read_bytes()
    with pytest.raises(RequestError, match="never overwritten"):
        new_key(ours)
    assert ours.read_bytes() == before
    with pytest.raises(RequestError, match="is a private key; trust takes the public one"):
        load_public_keys([ours])
    with pytest.raises(RequestError, match="not a private key"):
        load_private_key(f"{ours}.pub")
    with pytest.raises(RequestError, match="No such file"):
        load_public_keys([tmp_path / "absent.pub"])
    with pytest.raises(RequestError, match="folder of yours"):
        new_key(tmp_path / "absent" / "key")


def test_keys_of_other_kinds_and_with_passwords_are_refused(tmp_path):
    encoding, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    rsa = generate_private_key(65537, 2048)
    path = tmp_path / "other.key"
    path.write_bytes(rsa.private_bytes(encoding, pkcs8, serialization.NoEncryption()))
    with pytest.raises(RequestError, match="wanted an ed25519 private key"):
        load_private_key(path)
    shown = rsa.public_key().public_bytes(encoding, serialization.PublicFormat.SubjectPublicKeyInfo)
    path.write_bytes(shown)
    with pytest.raises(RequestError, match="wanted an ed25519 public key"):
        load_public_keys([path])
    locked = Ed25519PrivateKey.generate().private_bytes(
        encoding, pkcs8, serialization.BestAvailableEncryption(b"secret")
    )
    path.write_bytes(locked)
    with pytest.raises(RequestError, match="unencrypted"):
        load_private_key(path)
    path.write_bytes(b"\x00" * (1 << 17))
    with pytest.raises(RequestError, match="small PEM file"):
        load_public_keys([path])


def test_command_line_makes_signs_and_holds_to_keys(tmp_path, model_path, capsys):
    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            main([str(a) for a in arguments])
        return ended.value.code or 0, capsys.readouterr().err

    key = tmp_path / "cli.key"
    assert call("model", "--new-key", key)[0] == 0
    assert key.exists()
    log = ("run", "--log", tmp_path / "absent.log", "--model", model_path, "--trust", f"{key}.pub")
    status, said = call(*log)
    assert status == 2
    assert "is not signed" in said
    assert call("model", model_path, "--sign", key)[0] == 0
    assert "no such log file" in call(*log)[1]  # the model is past the check
    assert call("model", model_path, "--sign", tmp_path / "absent.key")[0] == 2


def test_swaps_and_reloads_are_held_to_the_keys_too(keys, model_path, ts_model, caplog):
    ours, stranger = keys
    sign_model(model_path, ours)
    runner = Runner(RunConfig(bus="virtual:signing", model=[str(model_path)], trust=[f"{ours}.pub"]))
    other = model_path.with_name("other.json")
    save_model(ts_model, other)
    runner.swapper.take("yaw", other.read_bytes())  # unsigned
    sign_model(other, stranger)
    runner.swapper.take("yaw", other.read_bytes())
    assert runner.swapper.counts == {"accepted": 0, "refused": 2}
    assert not runner._swap
    assert "the old one stays" in caplog.text
    sign_model(other, ours)
    runner.swapper.take("yaw", other.read_bytes())
    assert runner.swapper.counts == {"accepted": 1, "refused": 2}
    assert runner._swap["yaw"][0].terms == []
    save_model(ts_model, model_path)  # the file on disk is replaced by an unsigned one
    runner._swap.clear()
    runner.swapper.reload()
    assert runner.swapper.counts == {"accepted": 1, "refused": 3}
    assert not runner._swap


def test_trust_comes_from_the_configuration_file_as_well(keys, model_path, tmp_path):
    from rtcomp.config import load_config

    path = tmp_path / "run.toml"
    path.write_text(f'bus = "virtual:x"\nmodel = ["{model_path}"]\ntrust = ["{keys[0]}.pub"]\n')
    with pytest.raises(RequestError, match="not signed"):
        Runner(load_config(path))
    sign_model(model_path, keys[0])
    assert Runner(load_config(path)).pipeline.stacks[0][0].signature


def test_what_is_served_of_a_signed_model_can_be_put_to_another_run(keys, model_path):
    sign_model(model_path, keys[0])
    served = model_document(load_stacks([str(model_path)], ("yaw",), None)["yaw"][0])
    assert parse_model(json.dumps(served), "served", public(keys[0]))
