"""Terms of the paper that earn nothing measurable, one a module; off unless `[paper]` asks for them."""
