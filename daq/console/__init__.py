"""The live console: a page for the technician beside a recording, in a process of its own."""
