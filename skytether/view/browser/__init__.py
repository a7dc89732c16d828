"""Page server: sockets, threads and clocks are in this room, and the page's content is not."""
