"""Latencies counted in compiled code, against the library's own way of recording them."""

import numpy as np
from hdrh.histogram import HdrHistogram
from hypothesis import given
from hypothesis import strategies as st

from rtcomp.latency import DIGITS, HIGHEST_NS, PERCENTILES, STAGES, Timeline


@given(st.lists(st.lists(st.integers(0, HIGHEST_NS // 4), min_size=5, max_size=5), min_size=1, max_size=40))
def test_percentiles_are_those_of_the_library(rows):
    passages = np.cumsum(np.array(rows, np.int64), axis=1)
    timeline = Timeline()
    timeline.add(passages[:3])
    timeline.add(passages[3:])
    for stage, told in timeline.summary_us().items():
        start, end = STAGES[stage]
        slow = HdrHistogram(1, HIGHEST_NS, DIGITS)
        for latency in passages[:, end] - passages[:, start]:
            slow.record_value(int(latency))
        assert told == {name: slow.get_value_at_percentile(p) / 1000.0 for name, p in PERCENTILES.items()}


def test_nothing_passed_is_none_and_what_is_out_of_range_is_kept_at_its_end():
    timeline = Timeline()
    assert timeline.summary_us() == dict.fromkeys(STAGES)
    timeline.add(np.array([[0, -5, 3 * HIGHEST_NS, 0, 0]]))
    told = timeline.summary_us()
    assert told["receive"]["max"] == 0.0
    assert told["correct"]["p50"] >= HIGHEST_NS / 1000.0
