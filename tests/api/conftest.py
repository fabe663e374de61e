"""The command line and the folder of plug-ins, as in tests/framework."""

from tests.framework.conftest import bench, plugins, toy_folder

__all__ = ["bench", "plugins", "toy_folder"]
