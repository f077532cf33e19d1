"""Reading .rrd files back."""

from collections import defaultdict
from pathlib import Path

import numpy as np


class Rrd:
    """What a recording holds: `rows` per entity, `column` of one entity over time, `static` of one entity."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        reader = RrdReader(path)
        (entry,) = reader.recordings()
        self.blueprints = len(reader.blueprints())
        self.batches = defaultdict(list)
        self.still = {}
        for chunk in reader.stream(store=entry).to_chunks():
            if chunk.is_static:
                batch = chunk.to_record_batch()
                self.still |= {(chunk.entity_path, name): batch.column(name) for name in batch.schema.names}
            else:
                self.batches[chunk.entity_path].append(chunk.to_record_batch())
        self.entities = set(self.batches) | {entity for entity, _ in self.still}

    def rows(self, entity: str) -> int:
        return sum(batch.num_rows for batch in self.batches[entity])

    def column(self, entity: str, component: str) -> list:
        """(time [ns], value) of every row, in order of time."""
        rows = []
        for batch in self.batches[entity]:
            times = np.asarray(batch.column("time").cast("int64")).tolist()
            rows += zip(times, batch.column(component).to_pylist(), strict=True)
        return sorted(rows, key=lambda row: row[0])

    def scalars(self, entity: str) -> tuple[np.ndarray, np.ndarray]:
        rows = self.column(entity, "Scalars:scalars")
        return np.array([t for t, _ in rows]), np.array([values for _, values in rows])

    def static(self, entity: str, component: str) -> np.ndarray:
        (value,) = self.still[entity, component].to_pylist()
        return np.array(value)
