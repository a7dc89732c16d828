"""The commands of `skytether`, in groups."""

ABOUT = """usage: skytether COMMAND ...

Flies a UAV over a bad network: a server plans, a client flies, and netem,
between them, delays, reorders and loses their packets."""
COMMANDS_IN_GROUPS = {
    "Flying": {
        "fly [SCENARIO]": (
            "one flight, with all processes that it needs: start here",
            "skytether.cli.fly:fly",
        ),
        "fleet [SCENARIO]": (
            "many vehicles on one server, and missions",
            "skytether.cli.fleet:fleet",
        ),
        "duel SCENARIO...": (
            "scenarios on the same network, side by side on one page",
            "skytether.cli.duel:duel",
        ),
        "set PATH KEY=VALUE": (
            "change keys in flight, of a process with --control",
            "skytether.cli.set:set_keys",
        ),
        "ros2 FOLDER": (
            "plans and goals of a flight for RViz and other tools",
            "skytether.cli.ros2:connect",
        ),
    },
    "Any program's network": {
        "netem [SCENARIO]": (
            "a bad network between two programs, or around one",
            "skytether.netem.__main__:emulate",
        ),
        "policy serve|join": (
            "an unchanged policy on another machine than its robot",
            "skytether.policy.command:policy",
        ),
        "probe HOST:PORT": (
            "delay and loss of a real path, in each direction",
            "skytether.cli.probe:probe",
        ),
    },
    "After a flight": {
        "explain SCENARIO|FILE": (
            "why a flight braked or was far off, or a robot held",
            "skytether.explain.command:explain_flight",
        ),
        "replay FILE": (
            "a recording on the page that showed the flight",
            "skytether.cli.replay:replay",
        ),
        "report FILE": (
            "a recording as an HTML page with figures",
            "skytether.cli.report:report",
        ),
        "export FILE": (
            "a recording as tables, CSV or Parquet",
            "skytether.cli.export:export",
        ),
        "join FILE...": (
            "recordings of server, netem and client merged into one",
            "skytether.cli.join:join",
        ),
    },
    "Studies": {
        "sweep [SCENARIO]": (
            "a grid of scenarios, on all cores or a cluster",
            "skytether.lab.commands.sweep:sweep",
        ),
        "compare": (
            "schemes and triggers, each at its best weights",
            "skytether.lab.commands.compare:compare",
        ),
        "reproduce": (
            "a report with the paper's table and figures, and more",
            "skytether.lab.commands.reproduce:reproduce",
        ),
        "calibrate [SCENARIO]": (
            "a search for the paper's numbers, or for the best ones",
            "skytether.lab.commands.calibrate:calibrate",
        ),
        "margins [SCENARIO]": (
            "whether a scenario's loop is stable, for which vehicles",
            "skytether.lab.commands.margins:margins",
        ),
        "identify KIND": (
            "a vehicle's gain, time constant and dead time",
            "skytether.lab.commands.identify:identify",
        ),
    },
    "One process at a time": {
        "server [SCENARIO]": ("plans for vehicles", "skytether.server.__main__:serve"),
        "client [SCENARIO]": ("a vehicle", "skytether.client.__main__:fly"),
        "page FOLDER...": (
            "the page of flights of other commands",
            "skytether.view.browser.__main__:show",
        ),
        "keygen FILE": (
            "keys for vehicles, so that nobody else can fly them",
            "skytether.cli.keygen:keygen",
        ),
        "autopilot [SCENARIO]": (
            "a simulated autopilot that speaks MAVLink",
            "skytether.autopilot.__main__:pilot",
        ),
    },
    "Names and completion": {
        "list KIND": (
            "names of schemes, triggers, scenarios and so on",
            "skytether.cli.names:list_names",
        ),
        "completion SHELL": (
            "Tab completion of names and options: bash, zsh, fish",
            "skytether.cli.completion:complete",
        ),
    },
}
"""Groups of commands: usage, description and function. A function is imported when it is called, so
that `skytether netem` does not import the server's kernels.
"""
COMMANDS = {
    usage.partition(" ")[0]: place
    for group in COMMANDS_IN_GROUPS.values()
    for usage, (_, place) in group.items()
}

KINDS = (
    *("scenarios", "triggers", "reports", "schemes"),
    *("planners", "references", "impairments", "vehicles"),
)
"""Kinds that `skytether list` accepts. They are written out, because importing tables is slow."""
ELSEWHERE = {
    **{kind: f"skytether list {kind}" for kind in KINDS},
    "torture": "python -m fuzz.torture, in a checkout",
    "adversary": "python -m fuzz.adversary, in a checkout",
    "straight": "python -m bench.autopilots, in a checkout",
    "crowd": "python -m bench.crowd, in a checkout",
    "envelope": "skytether sweep",
}
"""Replacement of each former command, by the former name."""


def usage() -> str:
    lines = [ABOUT]
    for title, group in COMMANDS_IN_GROUPS.items():
        lines += ["", f"{title}:", *(f"  {use:21} {does}" for use, (does, _) in group.items())]
    return "\n".join(
        [*lines, "", "Each has a --help of its own. `skytether fly demo` flies a demonstration."]
    )
