"""docs/own-data.md is what a new user reads: its example runs; docs/reference/schema.md is the schema."""

import re
import subprocess
import sys
from pathlib import Path

from gsparc.data.schema import FIELDS

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGE = (DOCS / "own-data.md").read_text(encoding="utf-8")
SCHEMA = (DOCS / "reference" / "schema.md").read_text(encoding="utf-8")


def test_the_table_is_the_schema():
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+?) \| (.+?) \| (.+?) \|$", SCHEMA, flags=re.MULTILINE)
    documented = {name: (shape, unit, required, meaning) for name, shape, unit, required, meaning in rows}
    assert documented == {f.name: (f.shape, f.unit, f.required, f.meaning) for f in FIELDS.values()}


def test_the_example_makes_a_good_file(tmp_path):
    code = re.search(r"```python\n(.*?)```", PAGE, flags=re.DOTALL).group(1)
    assert len(code.strip().splitlines()) <= 10
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    command = [sys.executable, "-m", "gsparc", "check", "mine.npz"]
    said = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert said.returncode == 0, said.stdout + said.stderr
    assert "300 channels" in said.stdout and "2.4 GHz" in said.stdout and "mine.npz: good" in said.stdout
