"""What was measured, on disk: a run of a few stressors or methods renews theirs, and leaves the others as they are."""

import csv
import dataclasses
import json

from .families import order
from .judge import Cell


TABLE, NOTES = "stress.csv", "stress.json"


@dataclasses.dataclass
class Record:
    """The cells; of some the laws of growth {stressor: {method: law}}; figures {file: what it shows}."""

    cells: list[Cell]
    growth: dict[str, dict[str, dict[str, float]]] = dataclasses.field(default_factory=dict)
    figures: dict[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def read(cls, folder):
        """Empty where there is none."""
        if not (folder / TABLE).exists() or not (folder / NOTES).exists():
            return cls([])
        kinds = {field.name: field.type for field in dataclasses.fields(Cell)}
        with (folder / TABLE).open(newline="") as file:
            cells = [Cell(**{name: kinds[name](x) for name, x in row.items()}) for row in csv.DictReader(file)]
        return cls(cells, **json.loads((folder / NOTES).read_text()))

    def add(self, cell, law):
        """In place of what was there."""
        key = lambda x: (x.family, x.stressor, x.method)
        self.cells = sorted([x for x in self.cells if key(x) != key(cell)] + [cell], key=lambda x: order(*key(x)))
        if law is not None:
            self.growth.setdefault(cell.stressor, {})[cell.method] = law

    def of(self, family):
        """The cells of a family."""
        return [cell for cell in self.cells if cell.family == family]

    def write(self, folder):
        """Table and notes."""
        with (folder / TABLE).open("w", newline="") as file:
            table = csv.DictWriter(file, [field.name for field in dataclasses.fields(Cell)])
            table.writeheader()
            table.writerows(map(dataclasses.asdict, self.cells))
        notes = {"growth": self.growth, "figures": self.figures}
        (folder / NOTES).write_text(json.dumps(notes, indent=1, ensure_ascii=False) + "\n")
