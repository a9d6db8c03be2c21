"""The IDAM network, one file for each section of the paper."""
