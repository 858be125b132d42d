"""Tutorials: notebooks as text (docs/tutorials/*.py, jupytext's percent format), run and written down as pages.

    python docs/site/tutorials.py                  # all of them: docs/tutorials/*.md, docs/figures/tutorials/*.png

The pages are committed, since to run them takes half a minute; a test runs the notebooks and compares.
"""

from __future__ import annotations

import base64
import os
import re
import sys
import textwrap
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jupytext
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
FOLDER, FIGURES = ROOT / "docs" / "tutorials", ROOT / "docs" / "figures" / "tutorials"
AS_IT_IS: dict[str, Any] = {"subsequent_indent": "    ", "drop_whitespace": False, "break_on_hyphens": False}
LONGEST_S = 300
MOST_LINES, WIDTH = 45, 116  # of an output on the page
UNSEEN = re.compile(r"\x1b\[[0-9;]*m|[^\n]*\r(?!\n)")  # colours, lines that others replaced


def tutorials() -> list[str]:
    """Names of all tutorials."""
    return sorted(path.stem for path in FOLDER.glob("*.py"))


def execute(name: str, place: Path) -> Any:
    """The notebook with its outputs, run in a folder; raises nbclient's CellExecutionError where a cell fails."""
    notebook = jupytext.read(FOLDER / f"{name}.py")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    client = NotebookClient(notebook, timeout=LONGEST_S, kernel_name="python3", resources={"metadata": {"path": place}})
    return client.execute()


def page_of(notebook: Any, name: str) -> tuple[str, dict[str, bytes]]:
    """Markdown and pictures of an executed notebook."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        if text := printed(cell):
            parts.append(f"```text\n{text}\n```")
        for output in cell.outputs:
            if png := output.get("data", {}).get("image/png"):
                file = f"{name}-{len(pictures) + 1}.png"
                pictures[file] = base64.b64decode(png)
                parts.append(f"![Output of the cell above](../figures/tutorials/{file})")
    title, _, rest = "\n\n".join(parts).partition("\n\n")
    about = (
        f"The notebook is [{name}.py]({name}.py): VS Code opens it as it is, `jupytext --to ipynb {name}.py` makes an "
        f"`.ipynb` of it. What stands here was printed by `python docs/site/tutorials.py {name}`."
    )
    return f"{title}\n\n{about}\n\n{rest}\n", pictures


def printed(cell: Any) -> str:
    """What a cell printed, without colours and progress; long ones shortened."""
    texts = []
    for o in cell.outputs:
        if o.output_type == "stream" and o.name == "stdout":
            texts.append(o.text)
        elif o.output_type != "stream" and "image/png" not in o.get("data", {}):
            texts.append(o.get("data", {}).get("text/plain", "") + "\n")  # rich's lines and tables
    whole = UNSEEN.sub("", "".join(texts)).strip("\n").splitlines()
    lines = [part for line in whole for part in textwrap.wrap(line, WIDTH, **AS_IT_IS) or [""]]
    if len(lines) > MOST_LINES:
        lines = [*lines[: MOST_LINES - 10], "…", *lines[-9:]]
    return "\n".join(lines)


def code_blocks(page: str) -> list[str]:
    """The code of a page, cell by cell."""
    return re.findall(r"^```python\n(.*?)\n```$", page, re.M | re.S)


def main(names: list[str]) -> None:
    """Run and write."""
    FIGURES.mkdir(parents=True, exist_ok=True)
    for name in names or tutorials():
        with TemporaryDirectory() as place:
            page, pictures = page_of(execute(name, Path(place)), name)
        (FOLDER / f"{name}.md").write_text(page, encoding="utf-8")
        for old in FIGURES.glob(f"{name}-*.png"):
            old.unlink()
        for file, data in pictures.items():
            (FIGURES / file).write_bytes(data)


if __name__ == "__main__":
    main(sys.argv[1:])
