"""Views of a flight: live page and recordings.

    rows        rows of the record as plain columns, for tables, messages and arrays
    frames      a virtual flight as the frames that its processes would send
    recordings  recordings: write, read, join, export, report
    page        contents of a page: state, scene, plots, texts, sliders
    browser     the page's server: sockets, threads, clocks and panels

The input is frames (`shared.telemetry.feed`), from a feed, a recording or a flight in virtual time.
Recordings and the page do not import each other, and either may be missing. `make check` tests that
`browser` imports `page`, and `page` and `recordings` import `rows` and `frames`, never the reverse.
`view` may import `figures`, `sim` and the packages that these import.
"""
