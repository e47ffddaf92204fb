"""Documents that are kept or printed: one frozen type each, read and written here."""
