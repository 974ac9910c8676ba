# SPDX-License-Identifier: Apache-2.0
"""Lifted persons written to .npz, .csv or .json, with units, layout and coordinate frame stated."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from paul_ros.layout import Layout
from paul_ros.lifted import Lifted
from paul_ros.model import Model
from paul_ros.offline.arrays import Persons

Batches = Iterable[tuple[Persons, Lifted]]

_ORIGINS = {"m": "the camera", "model": "each person's root"}
_CSV_COLUMNS = "frame,person,keypoint,x,y,z,root_x,root_y,root_z,ambiguity,certified,distance_sigma,reason,units".split(
    ","
)


@dataclass(frozen=True)
class LiftedFile:
    """A file of lifted persons, before it is written.

    Attributes:
        layout: of the points.
        model: that lifted them.
        units: "m" or "model".
        axes: of the points, in words.
    """

    layout: Layout
    model: Model
    units: str
    axes: str

    def write(self, file: BinaryIO, kind: str, batches: Batches) -> None:
        """Write `npz`, `csv` or `json`; csv and json batch by batch. `paul lift --help` describes them."""
        {"npz": self._write_npz, "csv": self._write_csv, "json": self._write_json}[kind](file, batches)

    @property
    def _stated(self) -> dict[str, Any]:
        return {
            "units": self.units,
            "coordinate_frame": f"{self.axes}; origin at {_ORIGINS[self.units]}",
            "layout": self.layout.name,
            "keypoints": list(self.layout.names),
            "model": self.model.name,
            "model_sha256": self.model.sha256,
        }

    def _write_npz(self, file: BinaryIO, batches: Batches) -> None:
        columns: dict[str, list[np.ndarray]] = {}
        for persons, lifted in batches:
            for name, values in _arrays(persons, lifted).items():
                columns.setdefault(name, []).append(values)
        whole: dict[str, Any] = {name: np.concatenate(parts) for name, parts in columns.items()}
        whole.update((name, np.array(value)) for name, value in self._stated.items())
        np.savez(file, **whole)

    def _write_csv(self, file: BinaryIO, batches: Batches) -> None:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(_CSV_COLUMNS)
        for persons, lifted in batches:
            for person in _rows(persons, lifted):
                points, root = person["points"] or [["", "", ""]] * len(self.layout.names), person["root"] or [""] * 3
                sigma = person["distance_sigma"]
                tail = [person["ambiguity"], str(person["certified"]).lower(), sigma, person["reason"], self.units]
                for name, point in zip(self.layout.names, points):
                    writer.writerow([person["frame"], person["person"], name, *point, *root, *tail])
            # JSON allows half a surrogate pair in an id; UTF-8 does not.
            file.write(text.getvalue().encode(errors="backslashreplace"))
            text.seek(0)
            text.truncate()

    def _write_json(self, file: BinaryIO, batches: Batches) -> None:
        stated = "".join(f" {json.dumps(name)}: {json.dumps(value)},\n" for name, value in self._stated.items())
        file.write(f'{{\n{stated} "persons": ['.encode())
        separator = "\n  "
        for persons, lifted in batches:
            for person in _rows(persons, lifted):
                file.write((separator + json.dumps(person)).encode())
                separator = ",\n  "
        file.write(b"\n ]\n}\n")


def _arrays(persons: Persons, lifted: Lifted) -> dict[str, np.ndarray]:
    return {
        "frame": persons.frame,
        "person": np.array(persons.person, str),
        "points": lifted.points,
        "root": lifted.root,
        "ambiguity": lifted.ambiguity,
        "certified": lifted.certified,
        "distance_sigma": lifted.distance_sigma,
        "reason": np.array(lifted.reason, str),
    }


def _rows(persons: Persons, lifted: Lifted) -> Iterator[dict[str, Any]]:
    """Yield each person as plain values; None where there is no number."""
    columns = {name: values.tolist() for name, values in _arrays(persons, lifted).items()}
    for values in zip(*columns.values()):
        yield {name: _known(value) for name, value in zip(columns, values)}


def _known(value: Any) -> Any:
    """Return None for NaN, and for points that are all NaN, as those of a person that was not lifted are."""
    first = value[0] if isinstance(value, list) else value
    first = first[0] if isinstance(first, list) else first
    return None if first != first else value
