"""`python -m zsim_deploy.cli`: the command line of this interpreter's environment."""

from zsim_deploy.cli.cli import main

main()
