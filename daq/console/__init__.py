"""The live console: a page for the technician during a recording, in a process of its own."""
