"""Terms of the article that earn nothing measurable, one a module; off unless `[article]` asks for them."""
