"""Has all that flies in memory once imported, for all processes that are forked from it."""

import skytether.quadrotor.loops
import skytether.server.endpoint  # noqa: F401 - they are its kernels
from skytether.shared.base import kernel

kernel.check_types()
kernel.load()
