"""``report.json``: what a run measured."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from invrender.types import InputError, Notice

SCHEMA = 2  # of report.json; 1 had warnings without codes and no status


@dataclass
class Report:
    """What a run measured.

    status: "done", or "interrupted" where the maps are the best so far. size: pixels a side.
    sample_size: metres. seconds: by stage. photo_error: RMS difference of the re-rendered maps from
    the photo over its mean, "initial" and "refined". capture_fit: the screen's ``gain`` (RGB) and
    the numbers of `invrender.Lights.fit`, the ball's place. map_error: RMSE against the truth,
    "initial" and "refined", where the capture has one. photos: of several, the RMS difference
    of each, by name. notes: what was done to the photo's values as they were read.
    """

    status: str
    capture: str
    size: int
    init: str
    sample_size: float
    seconds: dict[str, float]
    photo_error: dict[str, float]
    converged: bool
    history: list[dict[str, float]]
    capture_fit: dict[str, Any]
    warnings: list[Notice]
    map_error: dict[str, dict[str, float]] | None
    versions: dict[str, str]
    notes: list[Notice] = field(default_factory=list)
    photos: dict[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """As ``report.json`` has it."""
        warnings, notes = ([n._asdict() for n in told] for told in (self.warnings, self.notes))
        return {"schema": SCHEMA, **asdict(self), "warnings": warnings, "notes": notes}

    @classmethod
    def read(cls, folder: Path) -> Report:
        """The report of a result's folder. Raises `InputError` where there is none to be read."""
        path = Path(folder) / "report.json"
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content.pop("schema", 1) != SCHEMA:
                raise InputError(f"{path} is of another version of invrender; refine again")
            warnings = [Notice(**w) for w in content.pop("warnings")]
            notes = [Notice(**n) for n in content.pop("notes", [])]
            return cls(**content, warnings=warnings, notes=notes)
        except OSError:
            raise InputError(f"{folder} has no report.json: it is no whole result") from None
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path} is not a report: {error}") from None
