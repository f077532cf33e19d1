"""The regressor groups that compete for the name: one per effect, keyed by its id in the catalogue."""

import numpy as np

from training.diagnose import columns as c
from training.diagnose import rate_columns as r
from training.diagnose.library import PPM, Group

TEMP, RATE = frozenset({"temperature"}), frozenset({"rate"})
TIME, BOTH = frozenset({"clock"}), frozenset({"temperature", "rate"})

GROUPS: tuple[Group, ...] = (
    Group(
        "bias_temperature",
        c.order_grid,
        lambda k, p: c.powers(c.above_room(k), p["order"], 1.0),
        c.poly_names("b", "dps"),
        TEMP,
    ),
    Group(
        "scale_temperature",
        c.order_grid,
        lambda k, p: [PPM * k.w * column for column in c.powers(c.above_room(k), p["order"], 1.0)],
        c.poly_names("s", "ppm"),
        BOTH,
    ),
    Group(
        "shupe",
        c.shupe_grid,
        c.shupe_columns,
        lambda p: [("c1_dps_s_per_K", "dps s/K"), ("c2_dps_s2_per_K", "dps s^2/K")][: int(p["order"])],
        TEMP | TIME,
        ("tau_s",),
    ),
    Group(
        "thermal_lag",
        c.lag_grid,
        c.thermal_lag,
        lambda p: [("scale_ppm_per_K", "ppm/K"), ("bias_dps_per_K", "dps/K")][
            : 1 + int(p.get("with_bias", 0.0))
        ],
        BOTH | TIME,
        ("tau_s",),
    ),
    Group(
        "bias_hysteresis",
        c.loop_grid,
        c.loop_columns,
        lambda p: [("c_dps_per_K", "dps/K"), ("b1_dps_per_K", "dps/K")][: 1 + int(p.get("with_static", 0.0))],
        TEMP | TIME,
        ("play_K",),
    ),
    Group(
        "scale_hysteresis",
        c.loop_grid,
        lambda k, p: [PPM * k.w * column for column in c.loop_columns(k, p)],
        lambda p: [("c_ppm_per_K", "ppm/K"), ("s1_ppm_per_K", "ppm/K")][: 1 + int(p.get("with_static", 0.0))],
        BOTH | TIME,
        ("play_K",),
    ),
    Group(
        "scale_temperature_rate",
        lambda s: [{"tau_s": tau} for tau in (5.0, 20.0, 40.0)],
        c.scale_rate,
        c.fixed_names(("c_ppm_s_per_K", "ppm s/K")),
        BOTH | TIME,
        ("tau_s",),
    ),
    Group("scale_nonlinearity", r.nonlinearity_grid, r.nonlinearity, r.nonlinearity_names, RATE),
    Group(
        "scale_asymmetry",
        c.no_grid,
        lambda k, p: [PPM * k.per_block(np.abs)],
        c.fixed_names(("c_ppm", "ppm")),
        RATE,
    ),
    Group("dead_band", r.dead_grid, r.dead_band, c.fixed_names(("depth", "1")), RATE, ("lock_dps",)),
    Group(
        "saturation",
        r.knee_grid,
        r.beyond_knee,
        c.fixed_names(("loss", "1")),
        RATE,
        ("limit_dps", "soft_dps"),
    ),
    Group(
        "polarization_ripple",
        c.ripple_grid,
        c.ripple_columns,
        c.fixed_names(("cos_dps", "dps"), ("sin_dps", "dps")),
        TEMP,
        ("period_K", "chirp_per_K"),
    ),
    Group(
        "compensation_table",
        c.sawtooth_grid,
        c.sawtooth,
        c.fixed_names(("amplitude_dps", "dps")),
        TEMP,
        ("period_K", "phase_K"),
    ),
    Group("bias_drift", c.no_grid, lambda k, p: [k.t], c.fixed_names(("c_dps_per_s", "dps/s")), TIME),
    Group(
        "source_ageing",
        lambda s: [{"shape": k} for k in (0.0, 1.0, 2.0, 3.0)],
        c.ageing_columns,
        lambda p: [
            [
                ("c_ppm_per_s", "ppm/s"),
                ("c_ppm_per_sqrt_s", "ppm/s^0.5"),
                ("c_ppm_per_ln", "ppm"),
                ("c_ppm_per_ln", "ppm"),
            ][int(p["shape"])]
        ],
        RATE | TIME,
    ),
    Group(
        "bias_warmup",
        c.tau_grid(60.0, 2500.0, 10),
        lambda k, p: [c.decay(k, p)],
        c.fixed_names(("amplitude_dps", "dps")),
        TIME | {"power_on"},
        ("tau_s",),
    ),
    Group(
        "scale_warmup",
        c.tau_grid(60.0, 2500.0, 10),
        lambda k, p: [PPM * k.w * c.decay(k, p)],
        c.fixed_names(("amplitude_ppm", "ppm")),
        RATE | TIME | {"power_on"},
        ("tau_s",),
    ),
    Group(
        "bias_step",
        c.change_grid,
        lambda k, p: [c.after_step(k, p)],
        c.fixed_names(("step_dps", "dps")),
        TIME,
        ("at_share",),
    ),
    Group("auto_zero", c.stop_grid, c.after_stops, c.stop_names, TIME | {"speed"}),
    Group(
        "scale_step",
        c.change_grid,
        lambda k, p: [PPM * k.w * c.after_step(k, p)],
        c.fixed_names(("step_ppm", "ppm")),
        RATE | TIME,
        ("at_share",),
    ),
    Group(
        "magnetic",
        lambda s: [{"order": k} for k in (1.0, 2.0)],
        lambda k, p: c.heading_columns(k, 1) + (c.heading_columns(k, 2) if p["order"] > 1.5 else []),
        lambda p: [("cos_dps", "dps"), ("sin_dps", "dps"), ("cos2_dps", "dps"), ("sin2_dps", "dps")][
            : 2 * int(p["order"])
        ],
        frozenset({"heading"}),
    ),
    Group(
        "table_eccentricity",
        lambda s: [{"order": k} for k in (1.0, 2.0)],
        c.rate_heading,
        lambda p: [("cos_ppm", "ppm"), ("sin_ppm", "ppm"), ("cos2_ppm", "ppm"), ("sin2_ppm", "ppm")][
            : 2 * int(p["order"])
        ],
        frozenset({"heading", "rate"}),
    ),
    Group(
        "acceleration",
        lambda s: [{"order": k} for k in (1.0, 2.0)],
        lambda k, p: [k.extra["accel"], k.extra["accel2"]][: int(p["order"])],
        lambda p: [("c1_dps_per_g", "dps/g"), ("c2_dps_per_g2", "dps/g^2")][: int(p["order"])],
        frozenset({"acceleration"}),
    ),
    Group(
        "vibration_rectification",
        c.no_grid,
        lambda k, p: [k.extra["vib2"]],
        c.fixed_names(("c_dps_per_m2s4", "dps/(m/s^2)^2")),
        frozenset({"vibration"}),
    ),
    Group(
        "misalignment",
        c.no_grid,
        lambda k, p: [k.extra["roll_rate"]],
        c.fixed_names(("roll_coupling", "dps/(m/s^3)")),
        frozenset({"acceleration"}),
    ),
)
