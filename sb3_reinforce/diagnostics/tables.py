"""Small tables of results: rows of one dataclass, found by name, printed, or handed on to pandas."""

from collections.abc import Iterator
from dataclasses import fields
from typing import Any, Generic, TypeVar

from sb3_reinforce.diagnostics.bootstrap import Estimate

Row = TypeVar("Row")


class Table(Generic[Row]):
    """
    Rows of one dataclass whose first field is a name.

    :param title: What the table shows
    :param rows: The rows, at least one
    """

    def __init__(self, title: str, rows: list[Row]):
        self.title, self.rows = title, rows
        self.columns = [field.name for field in fields(rows[0])]  # type: ignore[arg-type]

    @property
    def names(self) -> list[str]:
        """The first column."""
        return [str(getattr(row, self.columns[0])) for row in self.rows]

    def __getitem__(self, name: str) -> Row:
        if name not in self.names:
            raise ValueError(f"{self.columns[0]} must be one of {', '.join(map(repr, self.names))}, got {name!r}")
        return self.rows[self.names.index(name)]

    def __iter__(self) -> Iterator[Row]:
        return iter(self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __str__(self) -> str:
        cells = [self.columns, *([as_text(getattr(row, column)) for column in self.columns] for row in self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells
        ]
        return "\n".join([self.title, *lines])

    def to_pandas(self) -> Any:
        """
        The table as a DataFrame; an estimate takes three columns, ``x``, ``x_low`` and ``x_high``.

        :raises ImportError: If pandas is not installed
        """
        import pandas

        return pandas.DataFrame(self.to_records()).set_index(self.columns[0])

    def to_records(self) -> list[dict[str, Any]]:
        """The rows as dictionaries of names, numbers and texts."""
        records = []
        for row in self.rows:
            record: dict[str, Any] = {}
            for column in self.columns:
                value = getattr(row, column)
                if isinstance(value, Estimate):
                    record |= {column: value.value, f"{column}_low": value.low, f"{column}_high": value.high}
                else:
                    record[column] = value
            records.append(record)
        return records


def as_text(value: Any) -> str:
    """
    A cell of the printed table; what is not known is a dash.

    :param value: A text, a number or an estimate
    """
    if isinstance(value, Estimate):
        value = "-" if value.value != value.value else str(value)
    if isinstance(value, float):
        value = "-" if value != value else f"{value:.3g}"
    return str(value)
