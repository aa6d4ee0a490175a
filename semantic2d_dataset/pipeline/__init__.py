"""Room of the core: `semantic2d run`, from recordings and maps to a data set."""
