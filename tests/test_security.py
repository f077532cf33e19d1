"""Who may read and who may swap, on a real TLS network with certificates made on the spot."""

import json
import socket
import stat
import threading
import time

import pytest
import zenoh
from click.testing import CliRunner

from rtcomp.config import RunConfig
from rtcomp.errors import RequestError, WorkError
from rtcomp.model import model_document
from rtcomp.run import Runner
from rtcomp.zenoh_session import open_session
from rtcomp.zenoh_tls import (
    MAX_MESSAGE,
    VEHICLE,
    main,
    new_authority,
    tls_config,
    write_identity,
    write_network,
)

HOST = "127.0.0.1"
SWAP, RATE = "rtcomp/yaw/model/swap", "rtcomp/yaw/rate"


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """Folder of a vehicle's network, its port and authority."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        port = probe.getsockname()[1]
    folder = tmp_path_factory.mktemp("net")
    return folder, port, write_network(folder, HOST, port=port)


@pytest.fixture(scope="module")
def vehicle(network, fog_frames):
    """A run on the secured network, fed for as long as it stands."""
    from rtcomp.sources.bus import open_can
    from rtcomp.sources.transmit import replay

    folder, _, _ = network
    config = RunConfig(bus="virtual:secured", zenoh=str(folder / f"{VEHICLE}.json5"), allow_swap=True)
    runner = Runner(config)
    runner.start()
    loop = threading.Thread(target=runner.loop)
    loop.start()

    def feed():
        with open_can(config.bus) as bus:
            while not runner.stopped.is_set():
                replay([fog_frames(1.0)], bus, speed=1.0, stop=runner.stopped)

    feeder = threading.Thread(target=feed)
    feeder.start()
    yield runner
    runner.stop()
    feeder.join()
    loop.join()
    runner.close()


def wait_for(condition, seconds=8.0):
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.02)
    return condition()


def test_a_reader_reads_everything_that_is_served(network, vehicle):
    with open_session(network[0] / "reader.json5") as session:
        got = []
        session.declare_subscriber(RATE, lambda sample: got.append(1))
        assert wait_for(lambda: len(got) > 10)
        (schema,) = [json.loads(r.ok.payload.to_string()) for r in session.get("rtcomp/yaw/schema")]
        assert schema["schema"] == "rtcomp.corrected/1"
        assert [str(r.ok.key_expr) for r in session.liveliness().get("rtcomp/*/alive")] == [
            "rtcomp/yaw/alive"
        ]


def test_a_reader_does_not_swap_and_an_operator_does(network, vehicle, ts_model):
    payload = json.dumps(model_document(ts_model))
    before = dict(vehicle.swapper.counts)
    with open_session(network[0] / "reader.json5") as session:
        got = []
        session.declare_subscriber(RATE, lambda sample: got.append(1))
        assert wait_for(lambda: got)  # it is connected, and its put reaches the vehicle
        for _ in range(5):
            session.put(SWAP, payload)
            time.sleep(0.1)
        assert vehicle.swapper.counts == before
    with open_session(network[0] / "operator.json5") as session:
        time.sleep(0.5)
        session.put(SWAP, payload)
        assert wait_for(lambda: vehicle.swapper.counts["accepted"] == before["accepted"] + 1)


def test_what_is_larger_than_any_model_is_not_put_together(network, vehicle, ts_model):
    from zenoh import CongestionControl

    before = dict(vehicle.swapper.counts)
    with open_session(network[0] / "operator.json5") as session:
        time.sleep(0.5)
        session.put(SWAP, bytes(16 * MAX_MESSAGE), congestion_control=CongestionControl.BLOCK)
        session.put(SWAP, json.dumps(model_document(ts_model)), congestion_control=CongestionControl.BLOCK)
        assert wait_for(lambda: vehicle.swapper.counts["accepted"] == before["accepted"] + 1, 60.0)
    assert vehicle.swapper.counts["refused"] == before["refused"]


def test_a_reader_publishes_nothing_in_the_vehicles_name(network, vehicle):
    forged = []
    vehicle.publisher.session.declare_subscriber("rtcomp/pitch/rate", lambda sample: forged.append(1))
    with open_session(network[0] / "operator.json5") as session:
        time.sleep(0.5)
        for _ in range(5):
            session.put("rtcomp/pitch/rate", b"forged")
            time.sleep(0.05)
    assert not forged


def stranger_config(folder, port, name):
    """A client configuration of the right form for keys in `folder`."""
    config = tls_config(folder, name) | {"mode": "client", "connect": {"endpoints": [f"tls/{HOST}:{port}"]}}
    config["connect"] |= {"timeout_ms": 1500, "exit_on_failure": True}
    path = folder / "stranger.json5"
    path.write_text(json.dumps(config))
    return path


def refused(path):
    """Whether nothing at all can be read or asked with this configuration."""
    try:
        session = open_session(path)
    except WorkError:
        return True
    with session:
        got = []
        session.declare_subscriber(RATE, lambda sample: got.append(1))
        answers = [r for r in session.get("rtcomp/yaw/model", timeout=1.0) if r.ok]
        time.sleep(1.0)
        return not got and not answers


@pytest.mark.parametrize("kind", ["another authority", "expired", "no certificate", "own authority trusted"])
def test_a_wrong_certificate_is_refused(network, vehicle, tmp_path, kind):
    folder, port, authority = network
    ours = (folder / "ca.pem").read_bytes()
    other = new_authority("somebody else")
    (tmp_path / "ca.pem").write_bytes(ours)
    if kind == "expired":
        write_identity(tmp_path, "reader", authority, days=-1 / 1440)  # a minute ago
    else:
        write_identity(tmp_path, "reader", other)
    path = stranger_config(tmp_path, port, "reader")
    if kind == "no certificate":
        config = json.loads(path.read_text())
        tls = config["transport"]["link"]["tls"]
        for key in ("connect_private_key", "connect_certificate"):
            del tls[key]
        tls["enable_mtls"] = False
        path.write_text(json.dumps(config))
    elif kind == "own authority trusted":  # the vehicle must not pass for one of another network either
        from cryptography.hazmat.primitives.serialization import Encoding

        (tmp_path / "ca.pem").write_bytes(other.certificate.public_bytes(Encoding.PEM))
    before = dict(vehicle.swapper.counts)
    assert refused(path)
    assert vehicle.swapper.counts == before


def test_expired_is_the_only_thing_wrong_with_the_expired_one(network, vehicle, tmp_path):
    folder, port, authority = network
    (tmp_path / "ca.pem").write_bytes((folder / "ca.pem").read_bytes())
    write_identity(tmp_path, "reader", authority)
    assert not refused(stranger_config(tmp_path, port, "reader"))


def test_a_name_that_is_not_listed_gets_nothing(network, vehicle, tmp_path):
    folder, port, authority = network
    (tmp_path / "ca.pem").write_bytes((folder / "ca.pem").read_bytes())
    write_identity(tmp_path, "visitor", authority)  # a good certificate of the same authority
    assert refused(stranger_config(tmp_path, port, "visitor"))


def test_without_tls_nobody_gets_in(network, vehicle, tmp_path):
    path = tmp_path / "plain.json5"
    endpoint = {"endpoints": [f"tcp/{HOST}:{network[1]}"], "timeout_ms": 1500, "exit_on_failure": True}
    path.write_text(
        json.dumps({"mode": "client", "connect": endpoint, "scouting": {"multicast": {"enabled": False}}})
    )
    assert refused(path)


def test_keys_are_private_and_never_overwritten(network):
    folder = network[0]
    for key in folder.glob("*.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    with pytest.raises(RequestError, match="never overwritten"):
        write_network(folder, HOST)


def test_the_command_makes_configurations_that_zenoh_reads(tmp_path):
    done = CliRunner().invoke(
        main, [str(tmp_path / "net"), "--host", "localhost", "--reader", "a", "--operator", "b"]
    )
    assert done.exit_code == 0, done.output
    for name in (VEHICLE, "a", "b"):
        zenoh.Config.from_file(str(tmp_path / "net" / f"{name}.json5"))
    again = CliRunner().invoke(main, [str(tmp_path / "net"), "--host", "localhost"])
    assert again.exit_code == 2
