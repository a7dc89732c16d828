"""Pictures, tables and pages of flights, for commands, recordings and the laboratory.

    flights, film, probing  pictures of flights, of fleets in motion, of measured paths
    page, tables            an HTML page that opens offline, its tables, and CSV
    colours                 colours of modes and states, the live page's too

Nothing is registered. The package imports `shared`, `netem.impairments` and the results of
`probe`. Pictures need the extra `plot`.
"""
