from invrender.cli.main import run

run()
