"""Page of flights: what it shows, by viser; its server is `view.browser`.

    state     a flight's last minute, from the frames of its processes; `network` has netem's
    scene     vehicles, trails, plans and zones in space
    plots     curves of the last minute
    words     status, events and figures as HTML
    controls  numbers that can be changed in flight, as sliders
    changes   changes in flight in words

Nothing is registered. The package imports `view.rows`, `figures` and `shared`, and no module of it
has a socket, a thread or a clock. Scene and plots need the extra `page`.
"""
