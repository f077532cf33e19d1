"""From scored cases to the figures of a trial, every rate with its Clopper–Pearson interval."""

from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import Any

import numpy as np
from scipy.stats import binomtest

Document = dict[str, Any]
DPH = 3600.0
STRONG, FAINT = 12.0, (5.5, 10.5)
PROVED = 60.0  # of the oracle's gain on a held-out recording, below which a ratio to it says nothing
ALIKE = 0.8  # share of an effect outside the catalogue from which an entry passes for it (PHYSICS.md 3.4)


def rate(hits: Iterable[bool], wanted: str | None = None) -> Document:
    """{k, n, rate, low, high} with the exact 95 % interval; rate is null without cases."""
    values = [bool(v) for v in hits]
    k, n = sum(values), len(values)
    if n == 0:
        return {"k": 0, "n": 0, "rate": None, "low": None, "high": None, "wanted": wanted}
    interval = binomtest(k, n).proportion_ci(0.95, method="exact")
    return {
        "k": k,
        "n": n,
        "rate": k / n,
        "low": float(interval.low),
        "high": float(interval.high),
        "wanted": wanted,
    }


def spread(values: Iterable[float | None], wanted: str | None = None) -> Document:
    """{n, median, p10, p90, mean} of the finite values."""
    kept = np.array([v for v in values if v is not None and np.isfinite(v)], float)
    if not len(kept):
        return {"n": 0, "median": None, "p10": None, "p90": None, "mean": None, "wanted": wanted}
    low, middle, high = (float(q) for q in np.quantile(kept, [0.1, 0.5, 0.9]))
    return {
        "n": len(kept),
        "median": middle,
        "p10": low,
        "p90": high,
        "mean": float(kept.mean()),
        "wanted": wanted,
    }


def summarise(scores: list[Document]) -> Document:
    """All figures of a trial."""
    nulls = [s for s in scores if s["level"] == "L0"]
    singles = [
        s
        for s in scores
        if len(s["effects"]) == 1 and not s["unlisted"] and s["level"] in ("L1", "L2", "L3", "L4")
    ]
    listed = [s for s in scores if s["effects"] and not s["unlisted"]]
    return {
        "cases": len(scores),
        "not_done": [
            [s["case"], s["level"], s["status"], s.get("message", "")]
            for s in scores
            if s["status"] != "done"
        ],
        "null": _null(nulls),
        "single": _single(singles),
        "double": _double([s for s in scores if s["level"] in ("L6", "L7")]),
        "inseparable": _inseparable(scores),
        "unlisted": _unlisted([s for s in scores if s["unlisted"]]),
        "decoys": _levels(scores, "L9"),
        "integrity": _levels(scores, "L10"),
        "extra_names_per_case": spread([s["extra_names"] for s in listed], "mean <= 0.1"),
        "extra_unknown_per_case": spread([s["extra_unknown"] for s in listed]),
        "wrong_name_alone": rate([s["confident_wrong"] for s in listed]),
        "heldout": _heldout(scores),
        "parameters": _parameters(listed),
        "where": _where(scores),
        "limits_dph": _limits(scores),
        "confusion": _confusion(scores),
        "verdicts": {
            level: dict(Counter(s["verdict"] for s in scores if s["level"] == level))
            for level in _order(scores)
        },
        "seconds": spread([s["seconds"] for s in scores]),
    }


def _order(scores: list[Document]) -> list[str]:
    return sorted({s["level"] for s in scores}, key=lambda level: int(level[1:]))


def _null(nulls: list[Document]) -> Document:
    kinds = sorted({s["kind"] for s in nulls})
    return {
        "false_alarm": rate([s["false_alarm"] for s in nulls], "<= 0.01"),
        "remainder_printed": rate([s["remainder"] for s in nulls]),
        "by_scene": {kind: rate([s["false_alarm"] for s in nulls if s["kind"] == kind]) for kind in kinds},
        "alarms": [[s["case"], s["kind"], s["verdict"], s["findings"]] for s in nulls if s["false_alarm"]],
    }


def _single(singles: list[Document]) -> Document:
    strong = [(s, s["effects"][0]) for s in singles if s["effects"][0]["dprime"] >= STRONG]
    faint = [(s, s["effects"][0]) for s in singles if FAINT[0] <= s["effects"][0]["dprime"] <= FAINT[1]]
    apart = [e for _, e in strong if len(e["inseparable"]) == 1]
    return {
        "strong_first": rate([e["first"] for _, e in strong], ">= 0.90"),
        "strong_in_class": rate([e["in_class"] for _, e in strong], ">= 0.97"),
        "strong_in_class_of_3": rate([e["in_class_of_3"] for _, e in strong], ">= 0.97"),
        "strong_class_size": spread([e["class_size"] for e in apart], "mean <= 1.5"),
        "faint_first": rate([e["first"] for _, e in faint], ">= 0.75"),
        "faint_in_class": rate([e["in_class"] for _, e in faint], ">= 0.90"),
        "faint_wrong_alone": rate([s["confident_wrong"] for s, _ in faint], "<= 0.10"),
        "faint_silent": rate([not s["findings"] for s, _ in faint]),
        "driver_among_first_two": rate(
            [e["driver_located"] for _, e in strong if not e["frames"]], ">= 0.95"
        ),
        "extra_names": spread([s["extra_names"] for s in singles], "mean <= 0.1"),
    }


def _double(doubles: list[Document]) -> Document:
    plain = [s for s in doubles if s["level"] == "L6"]
    giants = [s for s in doubles if s["level"] == "L7"]
    return {
        "both_in_class": rate([all(e["in_class"] for e in s["effects"]) for s in plain], ">= 0.95"),
        "both_named": rate([all(e["any_first"] for e in s["effects"]) for s in plain], ">= 0.85"),
        "weak_in_class": rate([_weak(s)["in_class"] for s in plain]),
        "giant_and_dwarf_in_class": rate([all(e["in_class"] for e in s["effects"]) for s in giants]),
        "dwarf_in_class": rate([_weak(s)["in_class"] for s in giants]),
    }


def _weak(s: Document) -> Document:
    return min(s["effects"], key=lambda e: e["dprime"])


def _inseparable(scores: list[Document]) -> Document:
    designed = [entry for s in scores if s["level"] == "L5" for entry in s["silent"]]
    anywhere = [entry for s in scores for entry in s["silent"]]
    return {
        "silent_choice": rate([e["silent"] for e in designed], "0"),
        "in_class": rate([e["in_class"] for e in designed]),
        "advised": rate([e["advised"] for e in designed if e["in_class"] and not e["silent"]]),
        "silent_choice_anywhere": rate([e["silent"] for e in anywhere]),
    }


def _unlisted(strangers: list[Document]) -> Document:
    entries = [entry for s in strangers for entry in s["unlisted"]]
    unlike = [e for e in entries if e["catalogue_r2"] < ALIKE]
    alike = [e for e in entries if e["catalogue_r2"] >= ALIKE]
    return {
        "flagged": rate([e["flagged"] for e in unlike], ">= 0.90"),
        "driver_right": rate([e["driver_right"] for e in unlike if e["flagged"]], ">= 0.85"),
        "partly_explained": rate([e["partly"] for e in alike], ">= 0.70"),
        "nothing_said": rate([e["silent"] for e in entries]),
        "by_effect": {
            name: rate([e["flagged"] for e in entries if e["effect"] == name])
            for name in sorted({e["effect"] for e in entries})
        },
    }


def _levels(scores: list[Document], level: str) -> Document:
    entries = [(s, e) for s in scores if s["level"] == level for e in s["effects"]]
    return {
        "in_class": rate([e["in_class"] for _, e in entries]),
        "all_in_class": rate(
            [all(e["in_class"] for e in s["effects"]) for s in scores if s["level"] == level]
        ),
        "extra_names": spread([s["extra_names"] for s in scores if s["level"] == level]),
        "by_effect": {
            name: rate([e["in_class"] for _, e in entries if e["effect"] == name])
            for name in sorted({e["effect"] for _, e in entries})
        },
    }


def _heldout(scores: list[Document]) -> Document:
    def rows(chosen: list[Document]) -> list[Document]:
        return [r for s in chosen for r in s["heldout"] if r["fits"] and r["oracle_gain"] > PROVED]

    strong = [s for s in scores if s["effects"] and all(e["dprime"] >= STRONG for e in s["effects"])]
    one, two = ([s for s in strong if len(s["effects"]) == n and s["level"] != "L10"] for n in (1, 2))
    return {
        "misfit_ratio": spread([r["misfit_ratio"] for r in rows(one + two)], "median >= 0.95, p10 >= 0.75"),
        "rms_ratio_single": spread([r["rms_ratio"] for r in rows(one)], "median <= 1.05"),
        "rms_ratio_double": spread([r["rms_ratio"] for r in rows(two)], "median <= 1.10"),
        "misfit_ratio_unlisted": spread(
            [r["misfit_ratio"] for r in rows([s for s in scores if s["unlisted"]])]
        ),
        "files_that_fit": rate([r["fits"] for s in scores for r in s["heldout"]]),
    }


def _parameters(listed: list[Document]) -> Document:
    by_name: dict[str, list[Document]] = defaultdict(list)
    for s in listed:
        for e in s["effects"]:
            for p in e["parameters"]:
                by_name[f"{e['effect']}.{p['name']}"].append(p | {"dprime": e["dprime"]})
    everything = [p for rows in by_name.values() for p in rows]
    return {
        "coverage": rate([p["covered"] for p in everything if p["covered"] is not None], "0.90 .. 0.98"),
        "error_dprime_30": spread([p["error"] for p in everything if p["dprime"] >= 30]),
        "by_parameter": {name: spread([p["error"] for p in rows]) for name, rows in sorted(by_name.items())},
    }


def _where(scores: list[Document]) -> Document:
    return {
        "overlap": spread([s["overlap"] for s in scores if s.get("overlap") is not None], "median >= 0.6")
    }


def _limits(scores: list[Document]) -> Document:
    """What the tool says it could have seen in null recordings, and the smallest effects that it did find [°/h rms]."""
    said: dict[str, list[float]] = defaultdict(list)
    for s in scores:
        if s["level"] == "L0":
            for name, value in s["visible_from"].items():
                if value is not None:
                    said[name].append(value * DPH)
    found: dict[str, list[float]] = defaultdict(list)
    for s in scores:
        for e in s["effects"]:
            if e["in_class"] and e["rms_dps"]:
                found[e["effect"]].append(e["rms_dps"] * DPH)
    return {
        "said_visible_from": {name: spread(values) for name, values in sorted(said.items())},
        "smallest_found": {name: min(values) for name, values in sorted(found.items())},
    }


def _confusion(scores: list[Document]) -> Document:
    """{true effect: {first reported name: count}} over cases with at most one planted effect."""
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for s in scores:
        if len(s["truth"]) <= 1:
            name = s["truth"][0] if s["truth"] else "(null)"
            first = (
                s["findings"][0][0]
                if s["findings"]
                else ("(none)" if s["status"] == "done" else f"({s['status']})")
            )
            table[name][first] += 1
    return {name: dict(counts) for name, counts in sorted(table.items())}
