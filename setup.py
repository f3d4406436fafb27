"""
Two things that setup.cfg cannot say: where the hyperparameter file and the start-up hook go.

- ``hyperparams/trpo_gae.yml`` stands at the top of the repository, as in rl-zoo3, and belongs into the package.
- ``sb3_gae_zoo_hook.pth`` and ``.start`` belong beside the package, directly in site-packages. An editable install has
  to be told so a second time: setuptools builds it without the files of ``build_py``.
"""

import base64
import hashlib
import zipfile
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.editable_wheel import editable_wheel

STARTUP_FILES = ["sb3_gae_zoo_hook.pth", "sb3_gae_zoo_hook.start"]
# Source in the repository -> destination in site-packages
EXTRA_FILES = {
    "hyperparams/trpo_gae.yml": "sb3_gae/hyperparams/trpo_gae.yml",
    **{name: name for name in STARTUP_FILES},
}


class BuildPy(build_py):
    """``build_py`` that also builds ``EXTRA_FILES``."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return  # the checkout is what runs
        for target, source in self._extra_outputs().items():
            self.mkpath(str(Path(target).parent))
            self.copy_file(source, target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        return [*super().get_outputs(include_bytecode), *self._extra_outputs()]

    def get_output_mapping(self) -> dict[str, str]:
        return {**super().get_output_mapping(), **self._extra_outputs()}

    def get_source_files(self) -> list[str]:
        return [*super().get_source_files(), *EXTRA_FILES]

    def _extra_outputs(self) -> dict[str, str]:
        return {str(Path(self.build_lib, target)): source for source, target in EXTRA_FILES.items()}


class EditableWheel(editable_wheel):
    """``editable_wheel`` whose wheel also holds ``STARTUP_FILES``."""

    def run(self) -> None:
        super().run()
        (wheel,) = Path(self.dist_dir).glob("*.editable-*.whl")
        add_to_wheel(wheel, [Path(name) for name in STARTUP_FILES])


def add_to_wheel(wheel: Path, files: list[Path]) -> None:
    """
    Add files to the root of a wheel and to its RECORD, so that uninstalling removes them.

    It relies on the wheel format only; setuptools has no public way to add a file to an editable wheel.

    :param wheel: the wheel to change
    :param files: the files to add
    """
    with zipfile.ZipFile(wheel) as archive:
        contents = {info.filename: archive.read(info) for info in archive.infolist()}
    (record,) = (name for name in contents if name.endswith(".dist-info/RECORD"))
    for file in files:
        content = file.read_bytes()
        digest = base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
        contents[file.name] = content
        contents[record] = f"{file.name},sha256={digest},{len(content)}\n".encode() + contents[record]
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)


setup(cmdclass={"build_py": BuildPy, "editable_wheel": EditableWheel})
