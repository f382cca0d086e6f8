"""What a run of Weights & Biases left on disk: records of protocol buffers in a log of LevelDB's layout."""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

BLOCK, HEAD, START = 32768, 7, 7  # bytes


@dataclass
class Offline:
    """A run as the service would show it."""

    name: str = ""
    group: str = ""
    tags: list[str] = field(default_factory=list)
    config: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)

    def series(self, key: str) -> list[tuple[int, Any]]:
        """Steps and values."""
        return [(row["trainer/global_step"], row[key]) for row in self.rows if key in row]


def records(path: Path) -> Iterator[bytes]:
    content, at, whole = path.read_bytes(), START, b""
    while at + HEAD <= len(content):
        if BLOCK - at % BLOCK < HEAD:
            at += BLOCK - at % BLOCK
            continue
        _, length, kind = struct.unpack("<IHB", content[at : at + HEAD])
        whole += content[at + HEAD : at + HEAD + length]
        at += HEAD + length
        if kind in (1, 4):  # whole, or the last part
            yield whole
            whole = b""


def offline_run(folder: Path) -> Offline:
    """Of the only one in a run's folder."""
    from wandb.proto.wandb_internal_pb2 import Record

    (file,) = (folder / "wandb").glob("offline-run-*/*.wandb")
    run = Offline()
    for one in records(file):
        record = Record()
        record.ParseFromString(one)
        kind = record.WhichOneof("record_type")
        if kind == "run" and record.run.display_name:
            run.name, run.group, run.tags = record.run.display_name, record.run.run_group, [*record.run.tags]
        if kind == "config":
            run.config |= {item.key: json.loads(item.value_json) for item in record.config.update}
        if kind == "history":
            items = {
                item.key or ".".join(item.nested_key): json.loads(item.value_json)
                for item in record.history.item
            }
            run.rows.append(items)
    return run
