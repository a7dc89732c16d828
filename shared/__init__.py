"""Code of both ends of the link: endpoints, wire, model, reference, scenario, record."""
