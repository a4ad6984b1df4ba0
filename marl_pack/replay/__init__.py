"""The replay of a plan: a page for the browser, made of one file."""
