"""A registration to look at: the page and the picture."""
