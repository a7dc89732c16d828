"""Laboratory: studies, comparisons and searches made of many flights in virtual time.

    engine    cells and seeds of flights, statistics, searches, stability margins, the journal
    identify  a vehicle's model from small steps of velocity
    pages     tables, figures and text of a study's page, and docs/keys.md
    commands  what a user calls: options, worker processes, folders of results

Each imports only from those above it in this list, and `pages` nothing from `identify`. `engine` is
the library of the others, of `import skytether` and of the benchmarks. Only `commands` has
processes, clocks and sockets, and needs the extra `lab`. The laboratory registers nothing:
`skytether.cli.commands` names its commands. It may import every package but `gym` and `library`;
in the wheel only `library` imports it.
"""
