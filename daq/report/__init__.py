"""Tables, JSON documents, pictures and pages."""
