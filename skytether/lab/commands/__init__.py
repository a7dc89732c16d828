"""Commands of the laboratory: sweep, compare, reproduce, calibrate, margins, identify.

    pool           worker processes that fly the cells of a study, and the bar that shows progress
    report_folder  folder of a report: its page, its pictures, the commands that made it
    tables         tables printed on a terminal
    machine        processor and commit that figures were measured with
    delays         delays of packets through netem over UDP, for `skytether reproduce`

Each other module is a command, which `skytether.cli.commands` names. Benchmarks and fuzzing use
`pool`, `tables` and `machine` too. Importing the package needs the extra `lab`.
"""

from skytether.shared.base import extras

extras.need("lab")
