"""The paper's figures and certbound's own, drawn from what ``experiments`` computed."""
