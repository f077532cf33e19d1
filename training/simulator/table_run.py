"""Rate-table runs: soaked averages, one row per temperature and rate, as the paper's experiment."""

import numpy as np

from rtcomp.errors import RequestError
from training.effects.base import Columns, FrameEffect, NoiseEffect, TimingEffect
from training.effects.noise import DPS_PER_ARW
from training.effects.truth import Truth
from training.effects.units import PPM
from training.simulator.draw import Draw
from training.simulator.gyro import active, gyro_output
from training.simulator.scenario import Noise, Scenario, Table


def table_truth(table: Table) -> Truth:
    """Return the soaked points in the order of measurement, temperatures outside, shape `(temps·rates,)`.

    Times count from power-on: a soak before each temperature, then one average per rate.
    """
    temps, rates = np.array(table.temps_degC), np.array(table.rates_dps)
    soaks = np.repeat(np.arange(1, temps.size + 1) * table.soak_s, rates.size)
    averages = np.arange(temps.size * rates.size) * table.average_s
    return Truth(soaks + averages, np.tile(rates, temps.size), np.repeat(temps, rates.size), soaked=True)


def table_columns(scenario: Scenario, draw: Draw) -> tuple[Truth, Columns]:
    """Return the truth and the table's columns (no `t_s`: rows are independent points).

    A soak's common scale deviation and each point's reading noise are drawn (PHYSICS.md §4.2); of the gyro's
    own noise only the angle random walk is left in an average.

    Raises RequestError for effects that act on time stamps or frames, which a table has not.
    """
    table = scenario.table or Table()
    for entry, _ in active(scenario.gyro):
        if isinstance(entry, TimingEffect | FrameEffect | NoiseEffect) or entry.id == "bandwidth":
            raise RequestError(
                f"effect {entry.id} acts on samples in time; a table of averages has none: drop it"
            )
    truth = table_truth(table)
    rate = gyro_output(scenario.gyro, truth, None)
    soak_scale = table.soak_scale_ppm * PPM * draw.of("soak").standard_normal(len(table.temps_degC))
    rate += np.repeat(soak_scale, len(table.rates_dps)) * truth.rate_dps
    rate += point_noise(scenario, table) * draw.of("reading").standard_normal(rate.size)
    if table.lsb_dps > 0.0:
        rate = np.round(rate / table.lsb_dps) * table.lsb_dps
    columns = {"rate_dps": rate, "temp_degC": truth.temp_degC}
    return truth, columns | ({"ref_rate_dps": truth.rate_dps} if scenario.record.reference else {})


def point_noise(scenario: Scenario, table: Table) -> float:
    """Return the standard deviation of one averaged point [°/s]."""
    gyro = scenario.gyro
    walk = gyro.noise.arw_deg_rt_h if isinstance(gyro.noise, Noise) else 0.0
    return float(np.hypot(table.read_noise_dps, walk * DPS_PER_ARW / np.sqrt(table.average_s)))
