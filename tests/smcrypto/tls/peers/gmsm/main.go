// A TLCP peer made of gmsm's gmtls, for the tests of smcrypto.tls.
//
//	gmsm server -cert F -key F -enc-cert F -enc-key F [-client-ca F]   prints "port N"; then, for every connection,
//	                                                                  "done SUITE RESUMED PEER" or "failed REASON"
//	gmsm client ADDRESS -ca F -name HOST [-cert F -key F -enc-cert F -enc-key F]   the same lines
//
// Certificates and keys are PEM. The server sends back what it receives until the client closes; the client sends its
// stdin, reads as many bytes, and prints them after its line. ECC_SM4_CBC_SM3 only: gmsm has no GCM here, and its ECDHE
// panics.
package main

import (
	"flag"
	"fmt"
	"io"
	"net"
	"os"

	"github.com/tjfoc/gmsm/gmtls"
	"github.com/tjfoc/gmsm/x509"
)

var suites = map[uint16]string{gmtls.GMTLS_SM2_WITH_SM4_SM3: "ECC_SM4_CBC_SM3"}

func check(err error) {
	if err != nil {
		fmt.Println("failed", err)
		os.Exit(1)
	}
}

func pool(file string) *x509.CertPool {
	text, err := os.ReadFile(file)
	check(err)
	certificates := x509.NewCertPool()
	certificates.AppendCertsFromPEM(text)
	return certificates
}

func report(connection *gmtls.Conn) error {
	if err := connection.Handshake(); err != nil {
		return err
	}
	state := connection.ConnectionState()
	peer := "-"
	if len(state.PeerCertificates) > 0 {
		peer = state.PeerCertificates[0].Subject.CommonName
	}
	fmt.Println("done", suites[state.CipherSuite], state.DidResume, peer)
	return nil
}

func serve(connection *gmtls.Conn) {
	defer connection.Close()
	if err := report(connection); err != nil {
		fmt.Println("failed", err)
		return
	}
	io.Copy(connection, connection)
}

func main() {
	flags := flag.NewFlagSet("gmsm", flag.ExitOnError)
	cert, key := flags.String("cert", "", ""), flags.String("key", "", "")
	encCert, encKey := flags.String("enc-cert", "", ""), flags.String("enc-key", "", "")
	ca, clientCA, name := flags.String("ca", "", ""), flags.String("client-ca", "", ""), flags.String("name", "", "")
	config := &gmtls.Config{GMSupport: gmtls.NewGMSupport(), CipherSuites: []uint16{gmtls.GMTLS_SM2_WITH_SM4_SM3}}

	arguments := os.Args[2:]
	if os.Args[1] == "client" {
		arguments = os.Args[3:]
	}
	flags.Parse(arguments)
	for _, pair := range [][2]string{{*cert, *key}, {*encCert, *encKey}} {
		if pair[0] != "" {
			loaded, err := gmtls.LoadX509KeyPair(pair[0], pair[1])
			check(err)
			config.Certificates = append(config.Certificates, loaded)
		}
	}
	if os.Args[1] == "client" && len(config.Certificates) == 2 { // a client sends the chain of its first pair
		first := &config.Certificates[0]
		first.Certificate = append(first.Certificate, config.Certificates[1].Certificate...)
	}
	if *clientCA != "" {
		config.ClientAuth, config.ClientCAs = gmtls.RequireAndVerifyClientCert, pool(*clientCA)
	}

	if os.Args[1] == "server" {
		listener, err := net.Listen("tcp", "127.0.0.1:0")
		check(err)
		fmt.Println("port", listener.Addr().(*net.TCPAddr).Port)
		for {
			plain, err := listener.Accept()
			check(err)
			go serve(gmtls.Server(plain, config))
		}
	}
	config.RootCAs, config.ServerName = pool(*ca), *name
	plain, err := net.Dial("tcp", os.Args[2])
	check(err)
	connection := gmtls.Client(plain, config)
	check(report(connection))
	sent, err := io.ReadAll(os.Stdin)
	check(err)
	go connection.Write(sent)
	received := make([]byte, len(sent))
	_, err = io.ReadFull(connection, received)
	check(err)
	os.Stdout.Write(received)
	connection.Close()
}
