"""The global system of paper eq. (17): rows, triangles, linearisation."""
