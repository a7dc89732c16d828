"""Pictures, tables and pages of flights, for commands, recordings and the laboratory.

    flights, film, probing  pictures of flights and measured paths, films of fleets
    page, tables            an HTML page that opens offline, its tables, and CSV
    colours                 colours of modes and states, shared with the live page

The package imports `shared`, `netem.impairments` and the results of `probe`. Pictures need the
extra `plot`.
"""
