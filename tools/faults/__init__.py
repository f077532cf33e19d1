"""Named faults over one trace, each with what must come of it; run by `python -m tools.fault_campaign`."""
