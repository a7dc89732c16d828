"""Pages of the laboratory: what a study's results look like.

    plates         figures for print, with their numbers and captions
    figures        pictures of sweeps
    report         the page of a report, and the contents of `skytether reproduce`
    comparison     the contents of `skytether compare`
    keys_document  docs/keys.md, made from the keys of a scenario

Summaries and records of `lab.engine` go in, tables, pictures and HTML come out. The commands write
them to files, but for pictures of sweeps, which `figures` writes itself.
"""
