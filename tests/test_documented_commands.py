"""What README and docs give to type in a shell: each command is known, and takes the options that it is given."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest
from documented import COMMANDS, ROOT, after_python

from sb3_gae.sweep.arguments import make_parser

RESULTS = ROOT / "benchmarks" / "results" / "sweeps"
#: files of the user's own, which the text has before
OF_THE_USER = {"train.py", "enjoy.py", "-X"}
NAMED = {f"{document}: {shlex.join(words)}": words for document, commands in COMMANDS.items() for words in commands}
MODULES = {name: rest[1:] for name, words in NAMED.items() if (rest := after_python(words))[:1] == ["-m"]}
SCRIPTS = {name: rest for name, words in NAMED.items() if (rest := after_python(words)) and rest[0] != "-m"}


def options(words: list[str]) -> set[str]:
    return {word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)}


def sources(module: str) -> str:
    """:return: all code of the package or module that ``python -m`` runs"""
    top = importlib.util.find_spec(module.split(".")[0].replace("pytest", "_pytest"))
    assert top is not None, f"there is no {module}"
    assert importlib.util.find_spec(module) is not None, f"there is no {module}"
    return "\n".join(
        path.read_text() for folder in top.submodule_search_locations or () for path in Path(folder).rglob("*.py")
    )


def test_there_are_commands() -> None:
    assert len(MODULES) > 40
    assert len(SCRIPTS) > 5


@pytest.mark.parametrize("name", [name for name, words in MODULES.items() if words[0] == "sb3_gae.sweep"])
def test_the_sweep_knows_its_arguments_and_files(name: str) -> None:
    args = make_parser().parse_args(MODULES[name][1:])
    given = [*(getattr(args, "sources", None) or ()), *(getattr(args, "files", None) or ())]
    files = [Path(file) for file in given if file.endswith(".parquet")]
    assert all((ROOT / file).exists() or (RESULTS / file).exists() for file in files)


@pytest.mark.parametrize("name", [name for name, words in MODULES.items() if words[0] != "sb3_gae.sweep"])
def test_modules_are_there_and_have_the_options(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    module, *words = MODULES[name]
    code = sources(module)
    missing = [option for option in options(words) if f'"{option}"' not in code]
    assert not missing


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_there_and_have_the_options(name: str) -> None:
    script, *words = SCRIPTS[name]
    if script in OF_THE_USER:
        return
    code = (ROOT / script).read_text()
    assert all(f'"{option}"' in code for option in options(words))


@pytest.mark.parametrize("name", [name for name, words in NAMED.items() if words[0] == "make"])
def test_make_has_the_targets(name: str) -> None:
    makefile = (ROOT / "Makefile").read_text().replace("$(TIANSHOU)", ".venv-tianshou")
    targets = [word for word in NAMED[name][1:] if "=" not in word]
    assert all(re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE) for target in targets)
