"""Everything that fills or sends FRAME arrays: buses, logs, recordings; only here python-can is imported."""
