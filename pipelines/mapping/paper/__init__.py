"""Terms of the paper that something cheaper does as well; off unless `[paper]` asks for them."""
