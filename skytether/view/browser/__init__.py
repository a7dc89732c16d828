"""Page server: its sockets, threads and clocks; `skytether.view` has the page's content."""
