"""What both ends of the link agree on: endpoints, wire, model, reference, scenario, record."""
