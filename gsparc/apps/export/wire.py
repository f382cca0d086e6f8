"""What clients of `gsparc serve` send and get: bodies, and the page about them."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, FailFast, Field, ValidationError
from pydantic_core import to_json

from gsparc.base.files import refuse_repeated
from gsparc.data.assemble import FARTHEST
from gsparc.prediction.query import read_places

RAW = "application/octet-stream"
PLACE = 12  # bytes of a raw place

Metres = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Body = TypeVar("Body", bound=BaseModel)


class PlacesBody(BaseModel):
    """World places of what moves [m]."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    places: Annotated[list[tuple[Metres, Metres, Metres]], FailFast()]


class QueryBody(PlacesBody):
    """World places of what moves [m], and whether deviations are wanted, too."""

    std: bool = False


class RowsBody(PlacesBody):
    """World places of what moves [m], and levels there of each station; null is not measured.

    Rows of a `key` are taken once; without one as often as they come,
    as a sensor that stands still repeats.
    """

    levels: Annotated[list[list[float | None]], FailFast()]
    key: Annotated[str | None, Field(min_length=1, max_length=100)] = None


class PilotsBody(PlacesBody):
    """World places of what moves [m], and channels of one run there: real and imaginary parts by
    turns, in the order of an answer's values; null is not heard.
    """

    csi: Annotated[list[list[float | None]], FailFast()]


class AnswerBody(BaseModel):
    """Values of the shape in the unit, the last axis of channels real and imaginary part; null is a
    level of silence. Deviations have as many axes.
    """

    shape: list[int]
    unit: str
    values: list[Any]
    std: list[Any] | None = None


class FaultBody(BaseModel):
    """Why a request was refused, and where it is wrong."""

    detail: str


class Reply(NamedTuple):
    """Values (n, ...) float32, and their deviations where they are known, or wanted."""

    values: np.ndarray
    std: np.ndarray | None

    def part(self, rows: slice, std: bool) -> Reply:
        """Return that of some rows, with deviations if wanted; `ValueError` where none is known."""
        if std and self.std is None:
            raise ValueError("the model states no deviations")
        # Copies: a view would keep the others' answers.
        return Reply(self.values[rows].copy(), self.std[rows].copy() if std else None)  # type: ignore[index]

    def to_json(self, unit: str) -> bytes:
        """Return an `AnswerBody` as text."""
        answer = {"shape": self.values.shape, "unit": unit, "values": self.values.tolist()}
        std = {} if self.std is None else {"std": self.std.tolist()}
        # JSON has no word for the level of silence.
        return to_json(answer | std, inf_nan_mode="null")

    def to_raw(self) -> bytes:
        """Return values, then deviations."""
        return b"".join(part.tobytes() for part in self if part is not None)


def parse(text: bytes, body: type[Body]) -> Body:
    """Return a body; `ValueError` says where it is wrong, as in `places[3][1]: ...`."""
    try:
        parsed = body.model_validate_json(text)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_context=False)[0]
        steps = (f"[{step}]" if isinstance(step, int) else str(step) for step in fault["loc"])
        raise ValueError(": ".join(filter(None, ["".join(steps), fault["msg"]]))) from None
    # Of one key: of two alike the last would count.
    if text.count(b'"') != 2:
        json.loads(text, object_pairs_hook=refuse_repeated)
    return parsed


def parse_query(end: str, text: bytes, raw: bool, std: bool) -> tuple[np.ndarray, bool]:
    """Return world places (n, 3) float64 [m], and whether deviations are wanted, as the address
    says or the body; `ValueError`.
    """
    if not raw:
        body = parse(text, QueryBody)
        return read_places(end, body.places), std or body.std
    if len(text) % PLACE:
        raise ValueError("expected little-endian float32, three a place")
    return read_places(end, np.frombuffer(text, "<f4").reshape(-1, 3)), std


# What OpenAPI says of bodies that routes read themselves
_FLOATS = "float32, little-endian, three a place; ?std=true for deviations"
UPDATE_BODY = {"application/json": {"schema": RowsBody.model_json_schema()}}
HEAR_BODY = {"application/json": {"schema": PilotsBody.model_json_schema()}}
QUERY_BODY = {
    "application/json": {"schema": QueryBody.model_json_schema()},
    RAW: {"schema": {"type": "string", "format": "binary", "description": _FLOATS}},
}


def render_api_page(openapi: Mapping[str, Any]) -> str:
    """Return a page about all routes that needs nothing else."""
    page = f"<!doctype html><meta charset=utf-8><title>gsparc</title><h1>{openapi['info']['title']}"
    page += f"</h1><p>{html.escape(openapi['info']['description'])}"
    for path, methods in openapi["paths"].items():
        for method, route in methods.items():
            about = {name: route[name] for name in ("requestBody", "responses") if name in route}
            page += f"<h2>{method.upper()} {path}</h2><p>{html.escape(route['description'])}"
            page += f"<pre>{html.escape(json.dumps(about, indent=1))}</pre>"
    return page
