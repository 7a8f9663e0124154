"""How fast the parts are, and how much memory they take, on the machine at hand."""
