"""Questions asked of a model or posterior: what data can tell, what its numbers depend on."""
