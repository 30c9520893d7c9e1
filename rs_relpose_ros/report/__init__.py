"""One HTML page about a recording: a run over it, its evidence, drawings, the page."""
