# make figures | check | report: the paper's figures (FULL=1: its sample sizes); make gallery, make site: the documentation
PYTHON ?= python3

.PHONY: figures check report list gallery site
figures check report list:
	$(MAKE) -C paper_figs PYTHON=$(PYTHON) FULL=$(FULL) $@

gallery:
	OPENBLAS_NUM_THREADS=1 $(PYTHON) docs/gallery/build.py

site:
	$(PYTHON) -m mkdocs build --strict
