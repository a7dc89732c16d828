"""Page server: shows live or replayed flights in browsers; `view.page` has the contents.

    serve   address, token and end of a server; `python -m skytether.view.browser` is its process
    page    the thread that draws for all browsers
    panel   texts, plots and controls of one browser
    flight  a flight on a page, and requests for changes, which `play` sends to its processes
    replay  playback of recordings; `explaining` has buttons that explain flights in virtual time
    access  rules for who may watch and who may change a flight
    guard   limits of connections, messages and their rate

`skytether fly`, `page`, `replay` and `duel` start the server. The package imports `view.page`,
`view.frames`, `shell` and `shared`, never `view.recordings`, and runs `skytether explain` as a
process. It needs the extra `page`.
"""
