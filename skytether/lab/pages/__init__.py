"""Pages of the laboratory: tables, pictures and HTML for the results of a study.

    plates         figures for print, with their numbers and captions
    figures        pictures of sweeps
    report         the page of a report, and the contents of `skytether reproduce`
    comparison     the contents of `skytether compare`
    keys_document  docs/keys.md, made from the keys of a scenario

Pages are made from summaries and records of `lab.engine`. The commands write them to files, except
the pictures of sweeps, which `figures` writes itself.
"""
