"""The start-up hook, mostly against stand-ins for rl-zoo3 and for our own package that take no time to import."""

import os
import pkgutil
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import sb3_gae_zoo_hook

# All that the integration relies on
KNOWN_LAYOUT = {
    "__init__": '__version__ = "2.99"',
    "utils": """
        ALGOS = {"ppo": object}
        class ModelName(str):
            def __new__(cls, algo, env_name): return super().__new__(cls, f"{algo}-{env_name}")
        def get_hf_trained_models(): return {}
        """,
    "hyperparams_opt": "HYPERPARAMS_SAMPLER = {}; HYPERPARAMS_CONVERTER = {}",
    "exp_manager": """
        from rl_zoo3.hyperparams_opt import HYPERPARAMS_SAMPLER
        from rl_zoo3.utils import ALGOS
        class ExperimentManager:
            def __init__(self, args, algo, config=None): self.config = config or "hyperparams/of/the/zoo.yml"
            def _preprocess_hyperparams(self, hyperparams): ...
            def create_envs(self, n_envs, eval_env=False, no_log=False): ...
            def _load_pretrained_agent(self, hyperparams, env): ...
            def learn(self, model): ...
        """,
}


def write_package(folder: Path, name: str, modules: dict[str, str]) -> None:
    (folder / name).mkdir()
    for module, source in modules.items():
        (folder / name / f"{module}.py").write_text(textwrap.dedent(source))


def run_python(code: str, cwd: Path, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new interpreter that finds packages in ``cwd`` before all others."""
    variables = {key: value for key, value in os.environ.items() if key != sb3_gae_zoo_hook.OFF_SWITCH}
    variables["PYTHONPATH"] = str(cwd)
    return subprocess.run(
        [sys.executable, *options, "-c", textwrap.dedent(code)],
        cwd=cwd,
        env=variables | environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def check_python(code: str, cwd: Path, *options: str, **environment: str) -> list[str]:
    """Run code that must succeed in silence.

    :return: the words that it printed
    """
    result = run_python(code, cwd, *options, **environment)
    assert (result.returncode, result.stderr) == (0, "")
    return result.stdout.split()


LIST_FINDERS = "import sys; print(*(type(finder).__name__ for finder in sys.meta_path))"


def test_hook_is_there_at_start(tmp_path: Path) -> None:
    assert check_python(LIST_FINDERS, tmp_path).count("ZooFinder") == 1


@pytest.mark.parametrize(("value", "installed"), [("1", False), ("yes", False), ("0", True), ("", True)])
def test_environment_variable_turns_the_hook_off(tmp_path: Path, value: str, installed: bool) -> None:
    finders = check_python(LIST_FINDERS, tmp_path, SB3_GAE_NO_ZOO_HOOK=value)
    assert ("ZooFinder" in finders) is installed


def test_start_loads_nothing_heavy(tmp_path: Path) -> None:
    loaded = check_python("import sys; print(*sys.modules)", tmp_path)
    assert "sb3_gae_zoo_hook" in loaded
    assert not {"torch", "numpy", "gymnasium", "stable_baselines3", "rl_zoo3", "sb3_gae", "typing"} & set(loaded)


def test_hook_imports_only_what_every_interpreter_has_loaded(tmp_path: Path) -> None:
    """Without ``site`` (-S) no other start-up file can have hidden an import of ours."""
    code = f"""
        import os, sys
        sys.path.insert(0, {str(Path(sb3_gae_zoo_hook.__file__).parent)!r})
        before = set(sys.modules)
        import sb3_gae_zoo_hook
        print(*set(sys.modules) - before)
        """
    assert check_python(code, tmp_path, "-S") == ["sb3_gae_zoo_hook"]


def test_importing_other_packages_leaves_ours_out(tmp_path: Path) -> None:
    assert check_python("import json, sys; print('sb3_gae' in sys.modules)", tmp_path) == ["False"]


def startup_file(suffix: str) -> str:
    # In site-packages, or beside the hook in a checkout
    folders = [Path(entry) for entry in [*sys.path, str(Path(sb3_gae_zoo_hook.__file__).parent)]]
    return next(file for folder in folders if (file := folder / f"sb3_gae_zoo_hook{suffix}").is_file()).read_text()


def test_pth_is_one_guarded_import_line(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = startup_file(".pth").splitlines()
    assert line.startswith("import ")  # site executes no other
    monkeypatch.setitem(sys.modules, "sb3_gae_zoo_hook", None)  # as if the module had been deleted
    exec(line)


def test_start_file_names_the_same_callable() -> None:
    (entry,) = [line for line in startup_file(".start").splitlines() if not line.startswith("#")]
    assert pkgutil.resolve_name(entry) is sb3_gae_zoo_hook.install


def test_installing_twice_adds_one_finder(tmp_path: Path) -> None:
    assert check_python(f"import sb3_gae_zoo_hook as h; h.install(); {LIST_FINDERS}", tmp_path).count("ZooFinder") == 1


def test_modules_look_untouched_afterwards(tmp_path: Path) -> None:
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT)
    write_package(tmp_path, "sb3_gae", {"__init__": "", "zoo": "def integrate(module): print('integrated')"})
    code = """
        import inspect
        import rl_zoo3.utils as utils
        print(type(utils.__loader__).__name__, type(utils.__spec__.loader).__name__)
        print("ALGOS" in inspect.getsource(utils))
        """
    assert check_python(code, tmp_path) == ["integrated", "SourceFileLoader", "SourceFileLoader", "True"]


def test_a_watched_module_can_be_run_as_a_script(tmp_path: Path) -> None:
    """runpy asks the loader for the code."""
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT | {"utils": "print(__name__)"})
    assert check_python("import runpy; runpy.run_module('rl_zoo3.utils', run_name='__main__')", tmp_path) == ["__main__"]


def test_known_layout_is_integrated_whatever_is_imported_first(tmp_path: Path) -> None:
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT)
    for first in ("rl_zoo3.exp_manager", "sb3_gae.zoo"):
        code = f"""
            import {first}
            from rl_zoo3.exp_manager import ALGOS, ExperimentManager, HYPERPARAMS_SAMPLER
            print(*ALGOS, *HYPERPARAMS_SAMPLER)
            print(ExperimentManager(None, "trpo_gae").config.endswith("hyperparams/trpo_gae.yml"))
            print(ExperimentManager(None, "trpo_gae", "mine.yml").config, ExperimentManager(None, algo="ppo").config)
            """
        words = check_python(code, tmp_path)
        assert words == ["ppo", "trpo_gae", "trpo_gae", "True", "mine.yml", "hyperparams/of/the/zoo.yml"]


def test_reloading_and_registering_again_change_nothing(tmp_path: Path) -> None:
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT)
    code = """
        import importlib, rl_zoo3.exp_manager, rl_zoo3.utils
        from sb3_gae import zoo
        before = rl_zoo3.exp_manager.ExperimentManager.__init__, rl_zoo3.utils.get_hf_trained_models
        zoo.register()
        print(before == (rl_zoo3.exp_manager.ExperimentManager.__init__, rl_zoo3.utils.get_hf_trained_models))
        importlib.reload(rl_zoo3.utils)
        print(*rl_zoo3.utils.ALGOS)
        """
    assert check_python(code, tmp_path) == ["True", "ppo", "trpo_gae"]


def test_register_by_hand_needs_no_hook(tmp_path: Path) -> None:
    code = """
        import rl_zoo3.exp_manager
        print(*rl_zoo3.exp_manager.ALGOS)
        from sb3_gae import zoo
        zoo.register()
        print(*rl_zoo3.exp_manager.ALGOS, *rl_zoo3.exp_manager.HYPERPARAMS_SAMPLER)
        """
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT)
    words = check_python(code, tmp_path, SB3_GAE_NO_ZOO_HOOK="1")
    assert words == ["ppo", "ppo", "trpo_gae", "trpo_gae"]


UNKNOWN_LAYOUTS = {
    "utils.ALGOS": KNOWN_LAYOUT | {"utils": "ALGOS = ['ppo']"},
    "utils.get_hf_trained_models": KNOWN_LAYOUT | {"utils": "ALGOS = {'ppo': object}; ModelName = str"},
    "hyperparams_opt.HYPERPARAMS_SAMPLER": KNOWN_LAYOUT | {"hyperparams_opt": "HYPERPARAMS_SAMPLER = None"},
    "exp_manager.ExperimentManager(algo, config)": KNOWN_LAYOUT
    | {"exp_manager": "import rl_zoo3.utils\nclass ExperimentManager:\n    def __init__(self, settings): pass"},
    "exp_manager.ExperimentManager.create_envs": KNOWN_LAYOUT
    | {"exp_manager": KNOWN_LAYOUT["exp_manager"].replace("create_envs", "make_envs")},
}


@pytest.mark.parametrize("what", UNKNOWN_LAYOUTS)
def test_unknown_layout_is_refused_and_the_program_goes_on(tmp_path: Path, what: str) -> None:
    write_package(tmp_path, "rl_zoo3", UNKNOWN_LAYOUTS[what])
    code = """
        import rl_zoo3.utils
        import rl_zoo3.hyperparams_opt, rl_zoo3.exp_manager
        print(*rl_zoo3.utils.ALGOS)
        """
    result = run_python(code, tmp_path, "-W", "error")
    assert (result.returncode, result.stdout.split()) == (0, ["ppo"])  # others' algorithms, and not half of ours
    (line,) = result.stderr.splitlines()
    assert "rl_zoo3 2.99 has a layout that sb3-gae does not know" in line
    assert f"rl_zoo3.{what} is missing" in line
    assert "rl_zoo3>=2.9,<3" in line  # what to do

    refused = run_python("import sb3_gae.zoo as zoo; zoo.register()", tmp_path, SB3_GAE_NO_ZOO_HOOK="1")
    assert refused.returncode == 1
    assert f"UnsupportedZooError: rl_zoo3 2.99 has a layout that sb3-gae does not know: rl_zoo3.{what}" in refused.stderr


@pytest.mark.parametrize("source", ["raise RuntimeError('broken\\nin two lines')", "import no_such_module", "def"])
def test_a_broken_package_of_ours_breaks_nobody_else(tmp_path: Path, source: str) -> None:
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT)
    write_package(tmp_path, "sb3_gae", {"__init__": source})
    result = run_python("import rl_zoo3.exp_manager as m; print(*m.ALGOS)", tmp_path)
    assert (result.returncode, result.stdout.split()) == (0, ["ppo"])
    assert re.fullmatch(r"sb3-gae: rl-zoo3 goes without trpo_gae: \w+Error: .+\n", result.stderr)


def test_a_broken_package_is_survived_without_stderr(tmp_path: Path) -> None:
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT)
    write_package(tmp_path, "sb3_gae", {"__init__": "raise RuntimeError"})
    for closed in ("sys.stderr.close()", "sys.stderr = None"):
        code = f"import sys; {closed}; import rl_zoo3.exp_manager as m; print(*m.ALGOS)"
        assert run_python(code, tmp_path).stdout.split() == ["ppo"]


def test_errors_of_rl_zoo3_itself_are_left_alone(tmp_path: Path) -> None:
    write_package(tmp_path, "rl_zoo3", KNOWN_LAYOUT | {"utils": "raise KeyError('its own')"})
    result = run_python("import rl_zoo3.utils", tmp_path)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1] == "KeyError: 'its own'"
    assert "sb3-gae" not in result.stderr


def test_no_rl_zoo3_is_an_ordinary_import_error(tmp_path: Path) -> None:
    write_package(tmp_path, "rl_zoo3", {"__init__": ""})
    result = run_python("import rl_zoo3.utils", tmp_path)
    assert result.stderr.splitlines()[-1] == "ModuleNotFoundError: No module named 'rl_zoo3.utils'"


# From here on the real rl-zoo3


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_children_see_the_algorithm(tmp_path: Path, method: str) -> None:
    (tmp_path / "child.py").write_text(
        textwrap.dedent("""
        def algorithm() -> str:
            from rl_zoo3 import ALGOS
            return ALGOS["trpo_gae"].__module__
        """)
    )
    code = f"""
        import multiprocessing, sys
        from child import algorithm
        if __name__ == "__main__":
            with multiprocessing.get_context({method!r}).Pool(1) as pool:
                print(pool.apply(algorithm))
            print("rl_zoo3" in sys.modules)
        """
    assert check_python(code, tmp_path) == ["sb3_gae.trpo_gae", "False"]


def test_real_rl_zoo3_has_the_layout_we_know(tmp_path: Path) -> None:
    code = """
        from rl_zoo3 import ALGOS
        from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
        from sb3_gae import TRPOGAE, zoo
        print(ALGOS["trpo_gae"] is TRPOGAE)
        print(HYPERPARAMS_SAMPLER["trpo_gae"] is zoo.sample_trpo_gae_params)
        print(HYPERPARAMS_CONVERTER["trpo_gae"] is zoo.convert_trpo_gae_params)
        """
    assert check_python(code, tmp_path) == ["True"] * 3


@pytest.mark.parametrize("check_filename", [False, True])
def test_model_cards_lead_to_the_algorithm(tmp_path: Path, check_filename: bool) -> None:
    code = f"""
        from types import SimpleNamespace
        from huggingface_hub import HfApi

        def card(name, env_id):
            index = [dict(name=name, results=[dict(dataset=dict(name=env_id))])]
            return SimpleNamespace(id=f"someone/{{name}}-{{env_id}}", card_data={{"model-index": index}})

        files = {{"TRPOGAE": "trpo_gae-CartPole-v1.zip", "RecurrentPPO": "ppo_lstm-CartPole-v1.zip"}}
        HfApi.list_models = lambda self, author, cardData: [card(name, "CartPole-v1") for name in files]
        HfApi.model_info = lambda self, id: SimpleNamespace(
            siblings=[SimpleNamespace(rfilename=files[id.split("/")[1].split("-")[0]])]
        )
        from rl_zoo3.utils import get_hf_trained_models
        for name, (algo, env_id) in get_hf_trained_models("someone", check_filename={check_filename}).items():
            print(name, name.filename, algo, env_id)
        """
    assert check_python(code, tmp_path) == [
        *("trpo_gae-CartPole-v1", "trpo_gae-CartPole-v1.zip", "trpo_gae", "CartPole-v1"),
        *("ppo_lstm-CartPole-v1", "ppo_lstm-CartPole-v1.zip", "ppo_lstm", "CartPole-v1"),
    ]
