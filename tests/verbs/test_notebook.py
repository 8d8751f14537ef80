"""A notebook that calls verbs: what it shows of them while they run, and what stays in it."""

from __future__ import annotations

import os
import sys

import pytest

CELLS = (
    "import mdnum\nfrom mdnum.verbs import progress",
    # each picture of the bar stays, so that it can be looked at
    "shown = []\nclass Cell(progress._Cell):\n"
    "    def update(self, *a, **k): shown.append(k); super().update(*a, **k)\n"
    "progress._Cell = Cell",
    "outcome = mdnum.run('argon/liquid-864', steps=20_000, check=False, out='run')\noutcome",
    "print(outcome)",
    "outcome.plot('energy');",
    "mdnum.read('run')",
    "assert {one['description'] for one in shown} & {'compiling', 'running'}",
)


@pytest.mark.nightly
def test_a_notebook_shows_a_bar_and_then_the_outcome(tmp_path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    # the kernel of this interpreter, whatever others are installed
    (tmp_path / "kernels" / "here").mkdir(parents=True)
    (tmp_path / "kernels" / "here" / "kernel.json").write_text(
        '{"display_name": "here", "language": "python", '
        f'"argv": ["{sys.executable}", "-m", "ipykernel_launcher", "-f", "{{connection_file}}"]}}'
    )
    monkeypatch.setenv("JUPYTER_PATH", str(tmp_path))
    monkeypatch.delenv("MPLBACKEND", raising=False)
    monkeypatch.setitem(os.environ, "TF_CPP_MIN_LOG_LEVEL", "3")
    client = NotebookClient(book, kernel_name="here", timeout=300, resources={"metadata": {"path": tmp_path}})
    client.execute()
    outputs = [[dict(one) for one in cell.outputs] for cell in book.cells]
    bar, result = outputs[2]
    assert bar["data"] == {"text/plain": ""}, "the bar is gone"
    html = result["data"]["text/html"]
    assert html.startswith('<div class="mdnum-outcome">') and html.count("<svg") == 1
    assert result["data"]["text/plain"].startswith("mdnum run: argon/liquid-864\n")
    assert outputs[3][0]["text"].startswith(result["data"]["text/plain"])
    (picture,) = outputs[4]
    assert set(picture["data"]) == {"image/png", "text/plain"}
    assert outputs[5][0]["data"]["text/html"] == html
