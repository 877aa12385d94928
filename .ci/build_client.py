"""Assembles the distribution `mrasfm-client` from the product's sources: `build_client.py OUT`.

The modules that `mrasfm-client` needs, and no others, become the package `mrasfm_client`: `service.client` is
`mrasfm_client.service.client` there, and so on. Nothing of it has a name that a folder of somebody else may have.
"""

from __future__ import annotations

import ast
import re
import shutil
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = "mrasfm_client"
ROOTS = ("service.client", "service.commands.client_program")
OURS = ("schemas", "service")
DEPENDENCIES = ("httpx", "pydantic", "rich")
_IMPORT = re.compile(r"^(\s*)(from|import) (schemas|service)\b", re.MULTILINE)

INIT = '''"""Client of MRASfM, a service that turns recorded drives into maps.

The names of `mrasfm_client.service.client`, and its documentation, are those of this package.
"""

from mrasfm_client.service.client import *  # noqa: F403
from mrasfm_client.service.client import __all__ as __all__
'''
MAIN = '''"""`python -m mrasfm_client`: the command `mrasfm-client`."""

import sys

from mrasfm_client.service.commands.client_program import main

sys.exit(main())
'''
README = """# mrasfm-client

The client of an MRASfM service, as a command and as a library. It needs neither the engine nor the service.

```
export MRASFM_API_KEY=mrasfm_...
mrasfm-client upload my-drive --url https://maps.example.org --out my-scene
mrasfm-client list scenes --url https://maps.example.org
mrasfm-client export scn_... --format colmap --out my-export --url https://maps.example.org
```

```python
from mrasfm_client import AsyncClient, Client, download

with Client("https://maps.example.org", key) as client:
    for scene in client.scenes():
        print(scene.id, scene.name)
```
"""


def file_of(module: str) -> Path | None:
    """File of a module or package of ours; None where there is none of this name."""
    path = REPOSITORY.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


def needed(roots: tuple[str, ...]) -> dict[str, Path]:
    """All modules of ours that these import, by name, with the packages that they lie in."""
    found: dict[str, Path] = {}
    waiting = list(roots)
    while waiting:
        module = waiting.pop()
        path = file_of(module)
        if module in found or path is None:
            continue
        found[module] = path
        waiting += [module.rpartition(".")[0], *imports_of(path)]
    return found


def imports_of(path: Path) -> Iterator[str]:
    """Modules of ours that a file may import, wherever in it; names imported from a package may be modules."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] in OURS)


def _clear(out: Path) -> None:
    """Remove an earlier project; anything else in the folder is refused."""
    if not out.exists():
        return
    project_file = out / "pyproject.toml"
    is_ours = project_file.is_file() and 'name = "mrasfm-client"' in project_file.read_text(encoding="utf-8")
    if not is_ours and any(out.iterdir()):
        raise SystemExit(f"{out} is not empty, and holds no earlier build: give another folder")
    shutil.rmtree(out)


def assemble(out: Path) -> dict[str, Path]:
    """Write the project; the modules that it has."""
    modules = needed(ROOTS)
    target = out / PACKAGE
    _clear(out)
    for path in modules.values():
        copy = target / path.relative_to(REPOSITORY)
        copy.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_text(encoding="utf-8")
        copy.write_text(_IMPORT.sub(rf"\1\2 {PACKAGE}.\3", text), encoding="utf-8")
    (target / "__init__.py").write_text(INIT, encoding="utf-8")
    (target / "__main__.py").write_text(MAIN, encoding="utf-8")
    (target / "py.typed").touch()
    (out / "README.md").write_text(README, encoding="utf-8")
    shutil.copy(REPOSITORY / "LICENSE", out / "LICENSE")
    (out / "pyproject.toml").write_text(project(), encoding="utf-8")
    return modules


def project() -> str:
    """The distribution's `pyproject.toml`: version, licence and bounds of dependencies are the product's."""
    product = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = [d for d in product["dependencies"] if re.split(r"[<>=!~\[ ;]", d)[0] in DEPENDENCIES]
    assert len(wanted) == len(DEPENDENCIES), wanted
    dependencies = "".join(f'    "{dependency}",\n' for dependency in wanted)
    return f'''[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "mrasfm-client"
version = "{product["version"]}"
description = "Client of MRASfM, a service that turns recorded multi-camera drives into maps"
readme = "README.md"
license = "{product["license"]}"
license-files = ["LICENSE"]
requires-python = "{product["requires-python"]}"
dependencies = [
{dependencies}]

[project.scripts]
mrasfm-client = "{PACKAGE}.service.commands.client_program:main"

[tool.setuptools.packages.find]
include = ["{PACKAGE}*"]

[tool.setuptools.package-data]
{PACKAGE} = ["py.typed"]
'''


if __name__ == "__main__":
    print(f"{len(assemble(Path(sys.argv[1])))} modules in {sys.argv[1]}")
