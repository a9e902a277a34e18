"""Questions asked of a model or of a posterior: what data can tell, and what its numbers depend on."""
