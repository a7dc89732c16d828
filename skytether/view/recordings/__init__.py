"""Recordings: flights in MCAP files, which other programs such as Foxglove can read.

    recording  writes a file; `container` limits the memory for reading one
    recorded   reads a file: frames and rows, equal to the last bit
    joining    merges recordings of one flight's processes
    export     tables, CSV or Parquet
    traffic    netem's packets as delay traces and as a pcap capture
    outcome    sentences about what happened
    report     an HTML page with figures

`skytether fly --record`, `replay`, `report`, `export` and `join`, and `Flight` of `import
skytether`, import what they need. The package imports `view.rows`, `view.frames`, `figures` and
`shared`. Files need the extra `record`, reports `plot`, and Parquet `parquet`.
"""
