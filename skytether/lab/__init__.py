"""Laboratory: studies, comparisons and searches with many flights in virtual time.

    engine    cells and seeds of flights, statistics, searches, stability margins, the journal
    identify  a vehicle's model from small steps of velocity
    pages     tables, figures and text of a study's page, and docs/keys.md
    commands  commands for users: options, worker processes, folders of results

Each package imports only from the packages above it in this list; `pages` does not import
`identify`. `import skytether` and the benchmarks use `engine`, too. Only `commands` has processes,
clocks and sockets, and needs the extra `lab`. The commands are listed in `skytether.cli.commands`.
The laboratory may import every package but `gym` and `library`; in the wheel only `library` imports
it.
"""
