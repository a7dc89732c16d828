"""Recordings: flights in MCAP files, which other programs such as Foxglove read too.

    recording  writes a file; `container` bounds what reading one may cost
    recorded   reads a file: its frames, and their rows, bit for bit
    joining    recordings of the processes of one flight, as one
    export     tables, CSV or Parquet
    traffic    netem's packets as delay traces, and as a capture
    foxglove   messages that Foxglove draws
    outcome    what happened, in words
    report     an HTML page with figures

Nothing is registered: `skytether fly --record`, `replay`, `report`, `export` and `join`, and
`Flight` of `import skytether`, import what they need. The package imports `view.rows`,
`view.frames`, `figures` and `shared`. Files need the extra `record`, reports `plot`, and Parquet
`parquet`.
"""
