"""From a trained float graph to lower precision, with proof."""
