"""Engine of the laboratory: flights in virtual time, and figures computed from them.

    sweep        cells of a grid of scenarios × seeds, flown in chunks
    journal      results on disk, safe against crashes
    intervals    95 % confidence intervals
    search       CMA-ES over keys of a scenario, with the objectives of `calibration`
    studies      the paper's Table 1 and Fig. 5, and further studies
    contenders   schemes and triggers to compare, each with its own weights; `budgets` chooses their
                 thresholds, `floor` bounds their errors, `comparison` judges them
    margins      stability of a loop, and the vehicles for which it is stable

No module has a process, a clock or a socket: a cell is a function of its arguments, and
`lab.commands.pool` calls it in any process.
"""
