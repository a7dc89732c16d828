"""Imports all kernels of flights once, for all processes that are forked afterwards."""

import skytether.quadrotor.loops
import skytether.server.endpoint  # noqa: F401 - they are its kernels
from skytether.shared.base import kernel

kernel.check_types()
kernel.load()
