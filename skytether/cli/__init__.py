"""Commands that fly, show and mend flights; the laboratory has its own."""
