"""`python -m zsim_deploy.cli`: the command line of this interpreter's environment."""

from zsim_deploy.roles.closed_output import renew_streams

renew_streams()

from zsim_deploy.cli.cli import main  # noqa: E402

main()
