"""Writes the notebooks of this folder, with their outputs, as pages of the site: python examples/notebooks/pages.py."""

import base64
import json
import pathlib

NOTEBOOKS = pathlib.Path(__file__).parent
PAGES = NOTEBOOKS.parents[1] / "docs" / "tutorials" / "notebooks"  # git ignores it


def page(notebook: pathlib.Path, folder: pathlib.Path) -> str:
    """Returns the Markdown of a notebook, and writes its images into a folder."""
    parts, images = [], 0
    for cell in json.loads(notebook.read_text())["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if output["output_type"] == "stream" and output["name"] == "stdout":
                parts.append("```text\n" + "".join(output["text"]).rstrip() + "\n```")
            elif "image/png" in data:
                images += 1
                name = f"{notebook.stem}_{images}.png"
                (folder / name).write_bytes(base64.b64decode("".join(data["image/png"])))
                parts.append(f"![Output of the cell above]({name})")
    title, *rest = parts[0].split("\n", 1)
    where = f"From `examples/notebooks/{notebook.name}`, which runs in a few minutes on a CPU."
    return "\n\n".join([title, where, *rest, *parts[1:]]) + "\n"


def main():
    """Writes a page for each notebook."""
    PAGES.mkdir(exist_ok=True)
    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        (PAGES / f"{notebook.stem}.md").write_text(page(notebook, PAGES))


if __name__ == "__main__":
    main()
