"""Runs side by side: tables and plots of accuracy and its costs, as one page that opens offline."""
