"""Build the API reference, a page for each module, from the docstrings.

    nerfies study reference                # into build/reference

Written by pdoc (extra `docs`). Exit code 1 where a public name is on no page.
"""

import ast
import dataclasses
import pathlib

from experiments import cli
from nerfies_jax.capture import extras
from nerfies_jax.runtime import console

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGES = ("nerfies_jax", "gaussians_jax")


@dataclasses.dataclass(frozen=True)
class Reference:
    """Build the API reference."""

    out: pathlib.Path = pathlib.Path("build/reference")
    """Folder of the pages, which starts with index.html."""


@cli.command(Reference)
def main(args):
    """Write the pages. A missing public name ends with exit code 1."""
    pdoc = extras.library("pdoc", "docs")
    render = extras.library("pdoc.render", "docs")
    render.configure(docformat="markdown", math=True)
    names = _public_names()
    # A package without a face of its own brings its modules along.
    documented_modules = [
        module for module in names if _has_face(module.rpartition(".")[0])
    ]
    pdoc.pdoc(*documented_modules, output_directory=args.out)
    missing_names = [
        f"{module}.{name}"
        for module, present in names.items()
        for name in present
        if f'id="{name}"' not in page(args.out, module).read_text()
    ]
    for name in missing_names:
        console.error(f"{name} is on no page of the reference")
    console.say(f"{len(names)} modules: {args.out / 'index.html'}")
    result = {"folder": str(args.out), "modules": len(names), "missing": missing_names}
    return cli.Ended(result, 1 if missing_names else 0)


def page(folder: pathlib.Path, module: str) -> pathlib.Path:
    """Return the path of the page of a module."""
    return folder.joinpath(*module.split(".")).with_suffix(".html")


def _public_names() -> dict[str, list[str]]:
    """List the public functions and classes, or the face, of each module."""
    names = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            module = ".".join(part for part in parts if part != "__init__")
            face = path.with_suffix(".pyi")
            source = face if face.exists() else path
            names[module] = list(_public(source))
    return names


def _has_face(package):
    """Test if a package lists its names, and not those of its modules."""
    path = ROOT.joinpath(*package.split("."), "__init__.py")
    return not package or "__all__" in path.read_text()


def _public(path):
    tree = ast.parse(path.read_text())
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            yield from ast.literal_eval(node.value)
            return
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            if not node.name.startswith("_"):
                yield node.name
        # Of a face, `from .a import b as b`. Elsewhere the name is on the page of `a`.
        elif isinstance(node, ast.ImportFrom) and path.suffix == ".pyi":
            source = path.parent.joinpath(*(node.module or "").split("."))
            for alias in node.names:
                # A module in a face has a page of its own.
                target = source / alias.name
                is_module = target.with_suffix(".py").exists() or target.is_dir()
                if alias.asname == alias.name and not is_module:
                    yield alias.name


if __name__ == "__main__":
    main()
