"""Contents of the page that shows flights, drawn with viser; `view.browser` is its server.

    state     a flight's last minute, from its processes' frames; `network` for netem's frames
    scene     vehicles, trails, plans and zones in space
    plots     curves of the last minute
    words     status, events and figures as HTML texts
    controls  numbers that can be changed in flight, as sliders
    changes   descriptions of changes in flight

The package imports `view.rows`, `figures` and `shared`, and no module of it has a socket, a thread
or a clock. Scene and plots need the extra `page`.
"""
