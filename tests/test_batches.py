"""`…/batch`: the samples of `…/rate` again, whole, in order, and only for whoever subscribes."""

import time

import numpy as np
import pytest
import zenoh

from rtcomp.batches import INTERVAL_S, LARGEST, Batches
from rtcomp.frames import CORRECTED
from rtcomp.publisher import Publisher
from rtcomp.sources.clock import SteadyClock
from rtcomp.zenoh_session import open_session


@pytest.fixture
def session():
    opened = open_session(None)
    yield opened
    opened.close()


def samples(first, count):
    rows = np.zeros(count, CORRECTED)
    rows["seq"] = np.arange(first, first + count)
    rows["rate_dps"] = np.sin(rows["seq"])
    return rows


class Wire:
    """What a zenoh publisher does for `Batches`, with the hands of a clock."""

    def __init__(self, matching=True):
        self.matching_status, self.matching, self.sent = self, matching, []

    def put(self, payload):
        self.sent.append(np.frombuffer(payload, CORRECTED))

    def undeclare(self):
        pass


def test_every_sample_is_in_exactly_one_batch_and_no_batch_is_longer_than_the_interval():
    wires = [Wire(), Wire()]
    batches = Batches(wires)
    batches.watched()
    start = time.monotonic()
    for k in range(1000):
        for index in range(2):
            batches.add(samples(k, 1).tobytes(), bytes([index]))
        batches.flush(start + k / 1000.0)
    batches.close()
    for wire in wires:
        assert np.concatenate(wire.sent)["seq"].tolist() == list(range(1000))
        assert max(len(batch) for batch in wire.sent) <= 1000 * INTERVAL_S + 1
        assert len(wire.sent) <= 12


def test_nothing_is_gathered_while_nobody_subscribes():
    wire = Wire(matching=False)
    batches = Batches([wire])
    batches.add(samples(0, 10).tobytes(), bytes(10))
    batches.flush(time.monotonic() + 1.0)
    assert not wire.sent
    wire.matching = True
    batches.flush(time.monotonic() + 2.0)
    batches.add(samples(10, 10).tobytes(), bytes(10))
    batches.close()
    assert np.concatenate(wire.sent)["seq"].tolist() == list(range(10, 20))


def test_a_fast_log_goes_out_in_pieces_of_bounded_size():
    wire = Wire()
    batches = Batches([wire])
    batches.watched()
    for k in range(100):
        batches.add(samples(1000 * k, 1000).tobytes(), bytes(1000))
    batches.close()
    assert np.concatenate(wire.sent)["seq"].tolist() == list(range(100_000))
    assert max(batch.nbytes for batch in wire.sent) < LARGEST + 1000 * CORRECTED.itemsize


def test_batches_hold_what_the_rates_held_bit_for_bit(session):
    names = ("a", "b")
    rates, batches = {n: [] for n in names}, {n: [] for n in names}
    for leaf, into in (("rate", rates), ("batch", batches)):
        for name in names:
            session.declare_subscriber(
                f"p/{name}/{leaf}",
                zenoh.handlers.Callback(lambda m, i=into[name]: i.append(m.payload.to_bytes())),
            )
    publisher = Publisher(session, "p", names, SteadyClock(), lossless=True)
    assert publisher.wait_for_subscribers(10.0)
    publisher.start()
    for k in range(50):
        rows = samples(10 * k, 10)
        publisher.offer(rows, np.arange(10, dtype=np.uint8) % 2, 0)
        time.sleep(0.005)
    publisher.close()
    for name in names:
        deadline = time.monotonic() + 20.0
        while len(b"".join(batches[name])) < 250 * CORRECTED.itemsize or len(rates[name]) < 250:
            assert time.monotonic() < deadline
            time.sleep(0.01)
        assert b"".join(batches[name]) == b"".join(rates[name])
        assert len(batches[name]) < len(rates[name])
