"""Signed models: who made one can be told, and a run can be held to those it trusts.

Ed25519 over the canonical JSON that the hash is over (`rtcomp.model.canonical`), so neither the layout of the file
nor its `sha256` matters, and every number does. Keys are PEM files as other tools write and read them.
"""

import base64
import binascii
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from rtcomp.errors import RequestError

MAX_KEY_BYTES = 1 << 16


def new_key(path: str | Path) -> tuple[Path, Path]:
    """Make a key pair: the private key in `path` (mode 0600), the public one in `path`.pub.

    Returns both paths. Raises RequestError when one of the files is there already: a key is never overwritten.
    """
    private, public = Path(path), Path(f"{path}.pub")
    for file in (private, public):
        if file.exists():
            raise RequestError(
                f"{file} is there already and a key is never overwritten; give another name or move it away"
            )
    key = Ed25519PrivateKey.generate()
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_new(private, secret, 0o600)
    shown = key.public_key().public_bytes(
        serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo
    )
    write_new(public, shown, 0o644)
    return private, public


def write_new(path: Path, content: bytes, mode: int) -> None:
    """Write a file that is not there yet: never through a link, never readable by others for a moment.

    Raises RequestError when it is there already or cannot be written.
    """
    if path.exists():
        raise RequestError(
            f"{path} is there already and a key is never overwritten; give another name or move it away"
        )
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
    except OSError as error:
        raise RequestError(
            f"cannot write key {path}: {error.strerror}; give a file in a folder of yours"
        ) from error


def load_private_key(path: str | Path) -> Ed25519PrivateKey:
    """Read a private key; RequestError says what the file is instead."""
    content = _read(path)
    try:
        key = serialization.load_pem_private_key(content, password=None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise RequestError(
            f"{path}: not a private key in an unencrypted PEM file; make one with `rtcomp model --new-key FILE`"
        ) from error
    if not isinstance(key, Ed25519PrivateKey):
        raise RequestError(
            f"{path}: wanted an ed25519 private key; make one with `rtcomp model --new-key FILE`"
        )
    return key


def load_public_keys(paths: Sequence[str | Path]) -> tuple[Ed25519PublicKey, ...]:
    """Read the public keys that are trusted; RequestError says what a file is instead."""
    return tuple(_load_public_key(path) for path in paths)


def _load_public_key(path: str | Path) -> Ed25519PublicKey:
    content = _read(path)
    if b"PRIVATE KEY" in content:
        raise RequestError(
            f"{path} is a private key; trust takes the public one: {path}.pub, and keep this at home"
        )
    try:
        key = serialization.load_pem_public_key(content)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise RequestError(
            f"{path}: not a public key in a PEM file; wanted the FILE.pub of `rtcomp model --new-key FILE`"
        ) from error
    if not isinstance(key, Ed25519PublicKey):
        raise RequestError(
            f"{path}: wanted an ed25519 public key, the FILE.pub of `rtcomp model --new-key FILE`"
        )
    return key


def _read(path: str | Path) -> bytes:
    try:
        with Path(path).open("rb") as file:
            content = file.read(MAX_KEY_BYTES + 1)
    except OSError as error:
        raise RequestError(
            f"cannot read key {path}: {error.strerror}; give the path of a PEM file"
        ) from error
    if len(content) > MAX_KEY_BYTES:
        raise RequestError(f"{path}: more than {MAX_KEY_BYTES} bytes; a key is a small PEM file")
    return content


def sign_model(path: str | Path, key_path: str | Path) -> Any:
    """Seal and sign a model file in place, whatever hash and signature it had; returns the checked model.

    Raises RequestError for anything that is not a model or not a private key.
    """
    from rtcomp.model import canonical, read_document, write_sealed

    key = load_private_key(key_path)
    document = read_document(path)
    signature = base64.b64encode(key.sign(canonical(document))).decode()
    return write_sealed(document, path, signature=signature)


def check_signature(
    content: bytes, signature: str | None, keys: Sequence[Ed25519PublicKey], name: str
) -> None:
    """Refuse a model that none of `keys` has signed; `content` is what was signed.

    Raises RequestError naming the model.
    """
    if signature is None:
        raise RequestError(
            f"{name} is not signed, and only models signed by a trusted key are taken; "
            "sign it with `rtcomp model FILE --sign KEY`"
        )
    if not any(_is_signed(key, signature, content) for key in keys):
        raise RequestError(
            f"{name}: its signature is by none of the {len(keys)} trusted keys, or it was changed after signing; "
            "get it again from who made it, or trust their public key with --trust"
        )


def _is_signed(key: Ed25519PublicKey, signature: str, content: bytes) -> bool:
    try:
        key.verify(base64.b64decode(signature, validate=True), content)
    except (InvalidSignature, binascii.Error, ValueError):
        return False
    return True
