# A cloud machine on EC2 with an address that stays, for Terraform 1.5 or newer, or OpenTofu:
#
#     cd deploy/ec2
#     terraform init        # or: tofu init
#     terraform apply -var region=eu-central-1 -var ssh_from=YOUR_ADDRESS/32
#
# It prints the address; set-up does the rest (docs/deploy.md). The state that it leaves here has no secret.

terraform {
  required_version = ">= 1.5"
  required_providers {
    aws = {
      source  = "hashicorp/aws"
      version = ">= 5.0, < 7.0"
    }
  }
}

variable "region" {
  type        = string
  description = "Where the machine stands: near the robots, since each decision takes a round trip."
}

variable "ssh_from" {
  type        = string
  description = "The addresses that may log in, as in 203.0.113.9/32."
}

variable "robots_from" {
  type        = string
  default     = "0.0.0.0/0"
  description = "The addresses of robots, who prove who they are."
}

variable "instance_type" {
  type    = string
  default = "c5.large"
}

variable "ssh_public_key" {
  type    = string
  default = "~/.ssh/id_ed25519.pub"
}

provider "aws" {
  region = var.region
}

data "aws_ami" "debian" {
  owners      = ["136693071363"] # Debian's
  most_recent = true

  filter {
    name   = "name"
    values = ["debian-12-amd64-*"]
  }
}

resource "aws_key_pair" "holdfast" {
  key_name   = "holdfast"
  public_key = file(pathexpand(var.ssh_public_key))
}

resource "aws_security_group" "holdfast" {
  name        = "holdfast"
  description = "Robots from anywhere, people from their own addresses"
}

resource "aws_vpc_security_group_ingress_rule" "ssh" {
  security_group_id = aws_security_group.holdfast.id
  cidr_ipv4         = var.ssh_from
  ip_protocol       = "tcp"
  from_port         = 22
  to_port           = 22
}

resource "aws_vpc_security_group_ingress_rule" "robots" {
  for_each          = toset(["tcp", "udp"]) # udp for udp/ alone
  security_group_id = aws_security_group.holdfast.id
  cidr_ipv4         = var.robots_from
  ip_protocol       = each.key
  from_port         = 7447
  to_port           = 7447
}

# Packages, time and names.
resource "aws_vpc_security_group_egress_rule" "all" {
  security_group_id = aws_security_group.holdfast.id
  cidr_ipv4         = "0.0.0.0/0"
  ip_protocol       = "-1"
}

resource "aws_instance" "holdfast" {
  ami                    = data.aws_ami.debian.id
  instance_type          = var.instance_type
  key_name               = aws_key_pair.holdfast.key_name
  vpc_security_group_ids = [aws_security_group.holdfast.id]
  user_data              = file("${path.module}/../cloud-init/user-data.yaml")
  tags                   = { Name = "holdfast" }

  metadata_options {
    http_tokens = "required"
  }

  root_block_device {
    encrypted = true
  }

  # A newer image or file is for the next machine: this one updates itself.
  lifecycle {
    ignore_changes = [ami, user_data]
  }
}

# The certificate names it, so it stays when the machine stops, or is another one.
resource "aws_eip" "holdfast" {
  domain   = "vpc"
  instance = aws_instance.holdfast.id
}

output "address" {
  value = aws_eip.holdfast.public_ip
}

output "fingerprints" {
  description = "Prints the host's fingerprints, a few minutes after the start."
  value       = "aws ec2 get-console-output --latest --region ${var.region} --instance-id ${aws_instance.holdfast.id} --output text | grep SHA256"
}
