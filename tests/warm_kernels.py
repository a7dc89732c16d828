"""Kernels of flights: imported, for all processes that are forked afterwards.

As a program it compiles those that this machine lacks, before tests share its cores.
"""

import skytether.quadrotor.loops
import skytether.server.__main__
import skytether.sim.flight  # noqa: F401 - they are the kernels of flights
from skytether.server.schemes import loading
from skytether.shared.base import kernel, machine_code
from skytether.shell.commandline import terminal

loading.load_all()
kernel.check_types()
if __name__ == "__main__":
    terminal.prepare(machine_code.missing())
else:
    kernel.load()
