"""`python -m zsim_deploy.cli`: the command line in the environment of this interpreter."""

from zsim_deploy.roles.closed_output import renew_streams

renew_streams()

from zsim_deploy.cli.cli import main  # noqa: E402

main()
