"""The gyro simulator: a scenario in, a recording (always called simulated) out.

`scenario` holds what a TOML file may say, `motion` and `environment` make the truth, `gyro` the output,
`run` (and `table_run`) the recording, `output` the file, `on_recording` the same gyro on the drivers of a
real recording.
"""
