"""Page server: flights in browsers, live or replayed; `view.page` has what they show.

    serve   address, token and end of a server; `python -m skytether.view.browser` is its process
    page    the thread that draws for all browsers
    panel   words, plots and controls of one browser
    flight  a flight on a page, and requests to change it, which `play` sends to its processes
    replay  playback of recordings; `explaining` has buttons for a flight in virtual time
    access  who may look, and who may change the flight
    guard   limits of connections, messages and their rate

Nothing is registered; `skytether fly`, `page`, `replay` and `duel` start it. The package imports
`view.page`, `view.frames`, `shell` and `shared`, never `view.recordings`, and runs `skytether
explain` as a process. It needs the extra `page`.
"""
