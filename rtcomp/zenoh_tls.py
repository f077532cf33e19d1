"""A zenoh network that strangers can neither read nor swap models on, ready to use.

`python -m rtcomp.zenoh_tls FOLDER --host vehicle.example` makes a certificate authority and, for the vehicle and for
everyone named, a key, a certificate and a zenoh configuration (TLS on both sides, no scouting). The vehicle's holds
the access control: whatever is not allowed there is denied, and who is who is told by the certificate's common name.
Give each machine its own three files and `ca.pem`; keep `ca.key` off all of them.
"""

import datetime
import ipaddress
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rtcomp.errors import RequestError
from rtcomp.signing import write_new

VEHICLE, PORT, DAYS = "vehicle", 7447, 825
READ_LEAVES = ("rate", "batch", "health", "model", "schema", "alive")
SWAP_LEAF = "model/swap"
MAX_MESSAGE = 4 << 20  # bytes that the vehicle puts together of one message; zenoh's own limit is a GiB


class Authority(NamedTuple):
    """Who signs certificates."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


def new_authority(name: str = "rtcomp authority", days: int = DAYS) -> Authority:
    """A self-signed certificate authority."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _name(name)
    usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
    certificate = (
        _builder(subject, subject, key, days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .sign(key, hashes.SHA256())
    )
    return Authority(key, certificate)


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _builder(subject: x509.Name, issuer: x509.Name, key: Any, days: float) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(minutes=5))
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def write_identity(
    folder: Path, name: str, authority: Authority, hosts: Sequence[str] = (), days: float = DAYS
) -> None:
    """A key (mode 0600) and a certificate with common name `name`, valid for `hosts`: NAME.key and NAME.pem."""
    key = ec.generate_private_key(ec.SECP256R1())
    both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    certificate = (
        _builder(_name(name), authority.certificate.subject, key, days)
        .add_extension(
            x509.SubjectAlternativeName([_host(host) for host in hosts or (name,)]), critical=False
        )
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(both), critical=False)
        .sign(authority.key, hashes.SHA256())
    )
    _write_key(folder / f"{name}.key", key)
    write_new(folder / f"{name}.pem", certificate.public_bytes(serialization.Encoding.PEM), 0o644)


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    write_new(path, secret, 0o600)


def tls_config(folder: Path, name: str) -> dict[str, Any]:
    """What vehicle and others share: TLS only, both sides show a certificate, nobody is looked for."""
    at = folder.absolute()
    tls = {
        "root_ca_certificate": str(at / "ca.pem"),
        "listen_private_key": str(at / f"{name}.key"),
        "listen_certificate": str(at / f"{name}.pem"),
        "connect_private_key": str(at / f"{name}.key"),
        "connect_certificate": str(at / f"{name}.pem"),
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }
    limits = {"rx": {"max_message_size": MAX_MESSAGE}} if name == VEHICLE else {}
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"link": {"protocols": ["tls"], "tls": tls} | limits},
    }


def access_control(prefix: str, readers: Sequence[str], operators: Sequence[str]) -> dict[str, Any]:
    """The vehicle's: readers and operators read, operators swap models, all else is denied."""
    read, swap = [f"{prefix}/*/{leaf}" for leaf in READ_LEAVES], [f"{prefix}/*/{SWAP_LEAF}"]
    asks = ["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"]
    gives = ["put", "reply", "declare_queryable", "liveliness_token"]
    rules = [
        _rule("ask", "ingress", asks, read),
        _rule("give", "egress", gives, read),
        _rule("swap", "ingress", ["put"], swap),
        _rule("listen for swaps", "egress", ["declare_subscriber"], swap),
    ]
    subjects = [{"id": "readers", "cert_common_names": [*readers, *operators]}]
    policies = [{"rules": ["ask", "give"], "subjects": ["readers"]}]
    if operators:
        subjects.append({"id": "operators", "cert_common_names": list(operators)})
        policies.append({"rules": ["swap", "listen for swaps"], "subjects": ["operators"]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}


def write_network(
    folder: Path,
    host: str,
    readers: Sequence[str] = ("reader",),
    operators: Sequence[str] = ("operator",),
    prefix: str = "rtcomp",
    port: int = PORT,
) -> Authority:
    """Everything of one vehicle's network, into `folder`.

    Raises RequestError when a file is there already: a key is never overwritten.
    """
    names = [VEHICLE, *readers, *operators]
    if len(set(names)) < len(names):
        raise RequestError(f"a name stands twice in {', '.join(names)}; each is one certificate")
    folder.mkdir(parents=True, exist_ok=True)
    authority = new_authority()
    _write_key(folder / "ca.key", authority.key)
    write_new(folder / "ca.pem", authority.certificate.public_bytes(serialization.Encoding.PEM), 0o644)
    for name in names:
        write_identity(folder, name, authority, [host] if name == VEHICLE else ())
    control = access_control(prefix.strip("/"), readers, operators)
    vehicle = {"mode": "peer", "listen": {"endpoints": [f"tls/{host}:{port}"]}, "access_control": control}
    _write_config(folder, VEHICLE, vehicle)
    for name in names[1:]:
        _write_config(folder, name, {"mode": "client", "connect": {"endpoints": [f"tls/{host}:{port}"]}})
    return authority


def _write_config(folder: Path, name: str, own: dict[str, Any]) -> None:
    document = json.dumps(own | tls_config(folder, name), indent=2) + "\n"
    write_new(folder / f"{name}.json5", document.encode(), 0o644)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@click.option("--host", required=True, help="Name or address by which others reach the vehicle.")
@click.option("--port", default=PORT, show_default=True, help="The vehicle's port.")
@click.option("--reader", "readers", multiple=True, default=("reader",), help="Who may read; repeatable.")
@click.option(
    "--operator",
    "operators",
    multiple=True,
    default=("operator",),
    help="Who may also swap models; repeatable.",
)
@click.option(
    "--prefix", default="rtcomp", show_default=True, help="First part of every key, as in `rtcomp run`."
)
def main(
    folder: Path, host: str, port: int, readers: tuple[str, ...], operators: tuple[str, ...], prefix: str
) -> None:
    """Make keys, certificates and zenoh configurations for one vehicle and those who may talk to it.

    \b
    Example:
        python -m rtcomp.zenoh_tls net --host 192.168.1.7 --reader dashboard --operator workshop
        rtcomp run --bus socketcan:can0 --model model.json --zenoh net/vehicle.json5
        rtcomp view --zenoh net/dashboard.json5
    """
    try:
        write_network(folder, host, readers, operators, prefix, port)
    except RequestError as error:
        raise click.UsageError(str(error)) from error
    click.echo(
        f"{folder}: vehicle.json5 for `rtcomp run --zenoh`, and one for each of {', '.join(readers + operators)}"
    )


if __name__ == "__main__":
    main()
