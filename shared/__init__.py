"""Code shared by server, client and netem: endpoints, wire, model, reference, scenario, record."""
