"""Puts the configurations, the recording that one of them maps, and the citation into a wheel.

They keep their places relative to each other, so that the relative paths inside them stay valid.
"""

from pathlib import Path

from setuptools import Command, setup
from setuptools.command.build import build

FILES = ("configs/*.yaml", "tests/golden/a_square3.npz", "CITATION.cff")
FOLDER = "ratslam/packaged"  # see ratslam/runs/settings/packaged.py


class BuildConfigurations(Command):
    """A `setuptools.command.build.SubCommand`; an editable install uses the files of the checkout."""

    editable_mode = False

    def initialize_options(self) -> None:
        self.build_lib = ""

    def finalize_options(self) -> None:
        self.build_lib = self.get_finalized_command("build_py").build_lib

    def run(self) -> None:
        for built, source in self.get_output_mapping().items():
            self.mkpath(str(Path(built).parent))
            self.copy_file(source, built)

    def get_source_files(self) -> list[str]:
        return sorted(path.as_posix() for pattern in FILES for path in Path().glob(pattern))

    def get_output_mapping(self) -> dict[str, str]:
        files = [] if self.editable_mode else self.get_source_files()
        return {str(Path(self.build_lib, FOLDER, file)): file for file in files}

    def get_outputs(self) -> list[str]:
        return list(self.get_output_mapping())


class Build(build):
    """The build with the configurations."""

    sub_commands = [*build.sub_commands, ("build_configurations", None)]  # noqa: RUF012


setup(cmdclass={"build": Build, "build_configurations": BuildConfigurations})
