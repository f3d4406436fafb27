"""
What README and docs give to type in a shell, page by page: the blocks in their order and then what stands in sentences.

Each command is that of the page with smaller sizes, so that it ends within seconds.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from documented import COMMANDS, ROOT, after_python
from rliable import library

from sb3_gae.sweep.cli import main
from sb3_gae.zoo import default_hyperparams_path

#: what is added to a command that has these words; of an option that is given twice the last one counts
SMALLER = {
    "sb3_gae.sweep": "",
    "sb3_gae.sweep run": "--seeds 1 --iterations 2 --jobs 1 --no-progress -params n_envs:2 n_steps:64",
    "rl_zoo3.train": "-n 256 --eval-freq -1 -params n_envs:2 n_steps:64",
    "rl_zoo3.train -optimize": "-n 256 --n-trials 2 --n-evaluations 1 --no-optim-plots -params n_envs:2 n_steps:64",
    "rl_zoo3.train --trained-agent": "-n 4352 --eval-freq -1 -params n_envs:2 n_steps:64",
    "rl_zoo3.train --trial-id": "-n 256 --eval-freq -1 --trial-id 1 -params n_envs:2 n_steps:64",
    "rl_zoo3.enjoy": "-n 20 --no-render",
    "docs/record_biped.py": "--steps 20000 --horizon 100 --episodes 2 --file rollout.npz",
    "benchmarks.speed profile": "--quick --output seconds.json",
    "benchmarks/update_speed.py": "--rounds 1 --batch-size 512",
    "benchmarks/soak.py": "--minutes 0.05",
    "benchmarks.paper_tasks": "--report",
    # What is committed has been run: it says so, and prints the table
    "benchmarks.first_results": "",
    "benchmarks/ray_scaling_model.py": "",
    "benchmarks.value_fit_error": "",
    "benchmarks.policy_step_gain": "",
    "benchmarks.gate draw": "",
    "docs/gridworld_figures.py": "",
    "docs/training_figures.py": "",
    "docs/rules_over_tasks.py": "",
}

#: Python programs and arguments that another test runs, and the name that it knows them by
ELSEWHERE = {
    "benchmarks.peers": ("test_peers_run", "peers"),
    "docs/house.py": ("test_house", "house"),
    "docs/measured_lambda.py": ("test_document_figures", "measured_lambda"),
    "docs/lambda_variants.py": ("test_document_figures", "lambda_variants"),
    "docs/value_errors.py": ("test_document_figures", "value_errors"),
    "benchmarks/fault_injection.py": ("test_fault_injection", "fault_injection"),
    "sb3_gae.gridworld": ("test_lab_page", "sb3_gae.gridworld"),
    "rl_zoo3.record_video": ("test_zoo_verbs", "record_video"),
    "rl_zoo3.record_training": ("test_zoo_verbs", "record_training"),
    "rl_zoo3.plots.plot_train": ("test_zoo_verbs", "plots.plot_train"),
    "rl_zoo3.plots.all_plots": ("test_zoo_verbs", "plots.all_plots"),
    "rl_zoo3.plots.plot_from_file": ("test_zoo_verbs", "plots.plot_from_file"),
    "rl_zoo3.benchmark": ("test_zoo_verbs", "benchmark"),
    "enjoy.py": ("test_zoo_verbs", "enjoy.py"),
    "--load-best": ("test_zoo_verbs", "--load-best"),
    "--load-last-checkpoint": ("test_zoo_verbs", "--load-last-checkpoint"),
    "postgresql+psycopg://me@server/sweeps": ("test_sweep_postgresql", "postgresql_server"),
    "rollout_workers:2": ("test_zoo_keys", "rollout_workers"),
}

#: Python programs and arguments that no test runs, and why
NOT_RUN = {
    "benchmarks.gate": "by CI without arguments; with them minutes of a quiet machine",
    "benchmarks.speed": "minutes; test_speed_benchmarks runs the parts one by one, and makes the report",
    "benchmarks/speed/bench.py": "it times, and tests time nothing",
    "--memory": "four batches, the largest of 200 000 steps",
    "benchmarks/rollout_speed.py": "minutes of a quiet machine",
    "benchmarks/ray_speed.py": "minutes of a quiet machine",
    "benchmarks/ray_hosts.py": "network namespaces, for which it has to be root",
    "benchmarks/dial_latency.py": "a quiet machine and a browser",
    "docs/contact_sheet.py": "agents that are trained for hours",
    "importtime": "nothing of ours but the import, which test_zoo_hook looks at",
    "checkpoints/rl_model_4096_steps.zip": "a checkpoint of the reader's; docs/checkpoints.md has one that is made here",
    "--track": "an account",
    "train.py": "a cluster",
}

#: other programs that are not run, and why
NOT_PYTHON = {
    "make": "CI makes check, test, docs and bench; of the others `make train` is run here",
    "release": "by CI with the lowest versions, by hand with the highest",
    "pip": "CI installs",
    "source": "nothing to see",
    "sudo": "changes the machine",
    **dict.fromkeys(["ray", "srun", "helm", "kubectl", "sleep", "export"], "a cluster"),
}
#: parts of lines of a script for a cluster
OF_CLUSTERS = ("$SLURM_JOB_NODELIST", "$head", "$address", "rollout_workers:127", "rollout_workers:128")


def program_and_arguments(words: list[str]) -> list[str]:
    return [word for word in after_python(words) if word != "-m"]


def how(words: list[str]) -> str:
    """:return: the key of :data:`SMALLER` that fits best, empty if none does"""
    rest = program_and_arguments(words)
    keys = [key for key in SMALLER if rest[:1] == key.split()[:1] and set(key.split()) <= set(rest)]
    return max(keys, key=len, default="")


def is_left_out(words: list[str]) -> bool:
    named = set(program_and_arguments(words)) - set(how(words).split())
    return (
        Path(words[0]).name in NOT_PYTHON
        or bool(named & (ELSEWHERE.keys() | NOT_RUN.keys()))
        or any(word in shlex.join(words) for word in OF_CLUSTERS)
    )


def recipe(target: str) -> list[str]:
    """:return: what the Makefile runs for a target of one line"""
    text = (ROOT / "Makefile").read_text()
    (line,) = re.findall(rf"^{target}:.*\n\t\$\(IN_VENV\) (.*) \$\(ARGS\)$", text, re.MULTILINE)
    return shlex.split(line)


def to_run(document: str) -> list[list[str]]:
    """:return: the page's commands that are run here, each once, and those that change the folder"""
    found: list[list[str]] = []
    for words in COMMANDS[document]:
        command = recipe("train") if words == ["make", "train"] else words
        if command[0] == "cd" or (not is_left_out(command) and command not in found):
            found.append(command)
    return found


def smaller(words: list[str]) -> list[str]:
    """:return: program and arguments, and :data:`SMALLER` of it, their hyperparameters in one place"""
    given, more = program_and_arguments(words), SMALLER[how(words)].split()
    if "-params" in given and "-params" in more:
        start = given.index("-params")
        stop = next((n for n in range(start + 1, len(given)) if given[n].startswith("-")), len(given))
        more += given[start + 1 : stop]
        del given[start:stop]
    return given + more


def test_every_command_is_run_or_it_is_said_why_not() -> None:
    commands = [words for document in COMMANDS for words in to_run(document) if words[0] != "cd"]
    assert [shlex.join(words) for words in commands if not how(words)] == []


def test_what_is_said_of_other_commands_is_true() -> None:
    commands = [words for of_page in COMMANDS.values() for words in of_page]
    used = {word for words in commands for word in (*words, Path(words[0]).name)}
    assert {*ELSEWHERE, *NOT_RUN, *NOT_PYTHON} - used == set(), "no page has it any more"
    for word, (test, name) in ELSEWHERE.items():
        assert name in (ROOT / "tests" / f"{test}.py").read_text(), word


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """What a reader finds in the folder of the checkout, and the modules that pages tell to write."""
    ignored = shutil.ignore_patterns("_build", "__pycache__")
    for name in ("benchmarks", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=ignored)
    (tmp_path / "my_module.py").write_text(block_of("sweeps.md", "MyEnv-v0"))
    # The task without the training that the page shows with it
    (tmp_path / "my_tasks.py").write_text(block_of("tasks.md", "SwingUp-v0").partition("\nenv = ")[0])
    return tmp_path


def block_of(document: str, word: str, language: str = "python") -> str:
    """:return: the page's first block with that word"""
    text = (ROOT / "docs" / document).read_text()
    blocks = re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return next(block for block in blocks if word in block)


def at_work(document: str) -> bool:
    return any(words[0] != "cd" for words in to_run(document))


@pytest.mark.parametrize("document", [name for name in COMMANDS if at_work(name)])
def test_a_page_can_be_typed(document: str, checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(checkout))
    monkeypatch.setenv("PYTHONPATH", str(checkout))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.chdir(checkout)
    estimates = library.get_interval_estimates
    # The numbers are of no interest here, and a page has dozens of tables
    monkeypatch.setattr(library, "get_interval_estimates", lambda *args, **kwargs: estimates(*args, **(kwargs | {"reps": 20})))
    PREPARATIONS.get(document, lambda: None)()
    for words in to_run(document):
        if words[0] == "cd":
            os.chdir(checkout / words[1])
        else:
            run(smaller(words))


def results_of_another_machine() -> None:
    another = "run --env MyEnv-v0 --gym-packages my_module --gammas .96 --lambdas .92 --first-seed 7"
    run(smaller(["python", "-m", "sb3_gae.sweep", *another.split()]))
    run(["sb3_gae.sweep", "export", "--name", "MyEnv-v0", "-o", "from_there.csv"])
    shutil.rmtree("logs")


def checkpoints_as_the_page_makes_them() -> None:
    train = ["rl_zoo3.train", "--algo", "trpo_gae", "--env", "CartPole-v1", "-n", "8192", "--eval-freq", "-1"]
    small = ["-params", "n_envs:2", "n_steps:64"]
    (callback,) = re.findall(r'"(callback:\[.*\])"', (ROOT / "docs" / "checkpoints.md").read_text())
    run([*train, *small, callback])
    shutil.rmtree("checkpoints")
    write_settings("CartPole-v1", yaml.safe_load(block_of("checkpoints.md", "callback", "yaml"))["CartPole-v1"])
    run([*train, *small, "--conf-file", "my_settings.yml"])


def write_settings(task_id: str, more: dict[str, object]) -> None:
    """The shipped settings of a task and more, in a file of the reader's."""
    settings = yaml.safe_load(default_hyperparams_path().read_text())[task_id]
    Path("my_settings.yml").write_text(yaml.safe_dump({task_id: settings | more}))


#: what is done before the commands of a page, so that there is what it takes to be there
PREPARATIONS = {
    "sweeps.md": results_of_another_machine,
    "checkpoints.md": checkpoints_as_the_page_makes_them,
    "zoo.md": lambda: write_settings("HalfCheetah-v5", {}),
}


def run(words: list[str]) -> None:
    """A command that must succeed. Those of sweeps, of which there are many, run in this process."""
    program, *rest = words
    if program == "sb3_gae.sweep":
        assert main(rest) == 0, shlex.join(words)
        return
    module = [] if program.endswith(".py") else ["-m"]
    command = [sys.executable, *module, program, *rest]
    ended = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600)
    assert ended.returncode == 0, f"{shlex.join(words)}\n{ended.stdout}"
