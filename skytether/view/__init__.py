"""Views of a flight: its live page, and its recordings.

    rows        rows of the record as plain columns, for tables, messages and arrays
    frames      a virtual flight as the frames that its processes would send
    recordings  files: written, read, joined, exported, reported
    page        what a page shows: state, scene, plots, words, sliders
    browser     the page's server: sockets, threads, clocks and panels

The input is frames (`shared.telemetry.feed`), from a feed, a recording or a flight in virtual time.
Recordings and the page do not import each other, and either may be deleted; `make check` proves
that `browser` imports `page`, `page` and `recordings` import `rows` and `frames`, and not back.
Below stand `figures`, `sim` and all that they import.
"""
